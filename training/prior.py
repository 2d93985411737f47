"""Estimate the surface prior that ships: ``python -m training.prior --run runs/best``."""

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from model.refinement import PRIOR, SurfacePrior
from training.surfaces import load_surfaces, mirrored, rotated, split_by_heliostat, tilt_modes, untilted
from training.train import TrainConfig

Array = NDArray[np.float64]


def estimate(surfaces: Array, components: int = 96) -> SurfacePrior:
    """Mean and low-rank covariance of measured surfaces (N, 4, 8, 8) [m].

    A mirror is as likely as its mirror images, so that the surfaces seen from the left, turned about, and both, count
    too: four times the samples for directions that few heliostats show.
    """
    seen = np.concatenate([surfaces, mirrored(surfaces), rotated(surfaces), rotated(mirrored(surfaces))])
    # The mean stays that of the surfaces as they hang; gravity is not symmetric.
    mean = surfaces.mean(axis=0)
    deviations = (seen - np.concatenate([m[None].repeat(len(surfaces), 0) for m in _means(mean)])).reshape(
        len(seen), -1
    )
    _, singular, directions = np.linalg.svd(deviations, full_matrices=False)
    spread = singular[:components] / np.sqrt(len(seen) - 1)
    left_out = (singular[components:] ** 2).sum() / (len(seen) - 1) / directions.shape[1]
    measured = (directions[:components] * spread[:, None]).reshape(-1, *mean.shape)
    basis = untilted(np.concatenate([measured, canting_directions()]))
    return SurfacePrior(untilted(mean), orthogonal(basis), float(left_out**0.5))


def canting_directions(sigma_mrad: float = 0.6) -> Array:
    """Free canting of each facet (8, 4, 8, 8) [m], ``sigma_mrad`` of slope along x and along y.

    A facet's canting is set by hand and against a nominal focus that is not always the real one; the sample of measured
    heliostats does not show all of that.
    """
    free = np.zeros((4, 2, 4, 8, 8))
    for facet in range(4):
        free[facet, :, facet] = sigma_mrad * 1e-3 * tilt_modes()
    return free.reshape(8, 4, 8, 8)


def orthogonal(directions: Array) -> Array:
    """Orthogonal directions (K, 4, 8, 8) [m] of the same covariance, the longest first."""
    flat = directions.reshape(len(directions), -1)
    _, singular, axes = np.linalg.svd(flat, full_matrices=False)
    return np.asarray((singular[:, None] * axes)[singular > 1e-9].reshape(-1, *directions.shape[1:]))


def _means(mean: Array) -> list[Array]:
    return [mean, mirrored(mean), rotated(mean), rotated(mirrored(mean))]


def main() -> None:
    """Write the prior of a run's training heliostats."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--run", type=Path, default=Path("runs/best"))
    parser.add_argument("--out", type=Path, default=PRIOR)
    arguments = parser.parse_args()
    config = TrainConfig.read(arguments.run / "config.json")
    surfaces, _ = load_surfaces(Path(config.data))
    train, _ = split_by_heliostat(len(surfaces), config.held_out, config.seed)
    prior = estimate(surfaces[train])
    np.savez_compressed(
        arguments.out, mean=prior.mean.astype(np.float32), basis=prior.basis.astype(np.float32), residual=prior.residual
    )
    print(f"{arguments.out}: {len(prior.basis)} directions, {prior.residual * 1e3:.4f} mm per control point left out")


if __name__ == "__main__":
    main()
