"""Estimate the surface prior that ships: ``python -m training.prior --run runs/first``."""

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from model.refinement import PRIOR, SurfacePrior
from training.surfaces import load_surfaces, mirrored, rotated, split_by_heliostat
from training.train import TrainConfig

Array = NDArray[np.float64]


def estimate(surfaces: Array, components: int = 48) -> SurfacePrior:
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
    return SurfacePrior(
        mean, (directions[:components] * spread[:, None]).reshape(-1, *mean.shape), float(left_out**0.5)
    )


def _means(mean: Array) -> list[Array]:
    return [mean, mirrored(mean), rotated(mean), rotated(mirrored(mean))]


def main() -> None:
    """Write the prior of a run's training heliostats."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--run", type=Path, default=Path("runs/first"))
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
