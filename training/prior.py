"""Estimate the surface prior that ships: ``python -m training.prior --run runs/best``.

``--compare ../shared/stj`` prints which prior predicts measured mirrors best that were left out, ``--generic
../shared/stj`` the numbers of the generic prior that make the training mirrors most probable.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import gammaln

from model.prior import (
    FREEDOM,
    GROUPS,
    MEASURED_FACET,
    PRIOR,
    FacetKind,
    SurfacePrior,
    generic_covariance,
    generic_prior,
    orthogonal,
    principal,
    tilt_modes,
)
from training.config import TrainConfig
from training.surfaces import load_part, load_surfaces, split, untilted, with_symmetries

Array = NDArray[np.float64]


FACET_SHARE = 0.5
"""Share of the covariance that takes facets for independent samples of one kind (`shrunk`)."""

SPAN = 246
"""Directions by which priors are compared: so many all of them have, whichever mirror they lack."""

FLOOR = 7e-6
"""Standard deviation [m] of each control point on its own, of which no covariance of forty mirrors tells.

It looks like nothing, but slopes and so images feel it: left out, it spoils one to two percent of an image's peak.
"""


def estimate(surfaces: Array) -> SurfacePrior:
    """Mean and covariance of measured surfaces (N, 4, 8, 8) [m].

    A tilt of the whole mirror is kept apart: no image can show it.
    """
    mean = surfaces.mean(axis=0)
    measured = principal(shrunk(surfaces - mean) + FLOOR**2 * np.eye(mean.size), len(mean))
    directions = untilted(np.concatenate([measured, canting_directions()]))
    basis = orthogonal(directions - directions.mean(axis=(2, 3), keepdims=True))
    return SurfacePrior(untilted(mean), basis, tilts(surfaces))


def tilts(surfaces: Array) -> Array:
    """Tilts of the whole mirror along x and y (2, 4, 8, 8) [m], each as long as its root mean square in surfaces."""
    modes = np.repeat(tilt_modes()[:, None], 4, axis=1)
    slopes = surfaces.reshape(len(surfaces), -1) @ np.linalg.pinv(modes.reshape(2, -1))
    return np.asarray(np.sqrt((slopes**2).mean(axis=0))[:, None, None, None] * modes)


def shrunk(deviations: Array, share: float = FACET_SHARE) -> Array:
    """Covariance (256, 256) [m2] of deviations (N, 4, 8, 8) [m] from the mean.

    A mirror is as likely as its mirror images, so that the surfaces seen from the left, turned about, and both, count
    too. Some forty mirrors still span few of 256 dimensions, and a new mirror lies outside of them; their facets are
    four times as many samples of 64 dimensions. The covariance is a mean of both, as shrinkage estimates are (Ledoit
    and Wolf 2004), and half and half fits mirrors best that were left out.
    """
    seen = with_symmetries(deviations).reshape(-1, 256)
    whole = seen.T @ seen / len(seen)
    facets = np.zeros_like(whole)
    for facet in range(4):
        rows = slice(64 * facet, 64 * facet + 64)
        # The symmetric copies bring every facet to every place, so that each block already is a mean over facets.
        facets[rows, rows] = whole[rows, rows]
    return np.asarray((1 - share) * whole + share * facets)


def canting_directions(sigma_mrad: float = 0.6) -> Array:
    """Free canting of each facet (8, 4, 8, 8) [m], ``sigma_mrad`` of slope along x and along y.

    A facet's canting is set by hand and against a nominal focus that is not always the real one; the sample of measured
    heliostats does not show all of that.
    """
    free = np.zeros((4, 2, 4, 8, 8))
    for facet in range(4):
        free[facet, :, facet] = sigma_mrad * 1e-3 * tilt_modes()
    return free.reshape(8, 4, 8, 8)


def generic_kind(surfaces: Array) -> FacetKind:
    """The kind of facets that makes mirrors (N, 4, 8, 8) [m] most probable, whatever their tilts and facets' means."""
    flat = surfaces.reshape(len(surfaces), -1)
    unseen = np.concatenate(
        [np.repeat(tilt_modes()[:, None], 4, axis=1).reshape(2, -1), np.kron(np.eye(4), np.ones(64))]
    )
    seen = np.linalg.svd(unseen)[2][len(unseen) :].T

    def kind(logs: Array) -> FacetKind:
        canting, bending, reach, grain, odds = np.exp(logs).tolist()
        return FacetKind(canting, bending, reach, grain, odds / (1 + odds))

    def improbability(logs: Array) -> float:
        covariance = generic_covariance(np.tile(MEASURED_FACET, (4, 1)), kind(logs))
        lower = np.linalg.cholesky(seen.T @ covariance @ seen)
        left = np.linalg.solve(lower, seen.T @ flat.T)
        return float((left**2).sum() / 2 + len(flat) * np.log(np.diag(lower)).sum())

    logs = np.array([*np.log([2e-3, 2e-3, 1.0, 1e-4]), 0.0])
    simplex = np.vstack([logs, logs + 0.5 * np.eye(5)])
    found = minimize(improbability, logs, method="Nelder-Mead", options={"initial_simplex": simplex, "xatol": 0.01})
    return kind(found.x)


def compare(surfaces: Array) -> str:
    """What priors say of mirrors (N, 4, 8, 8) [m] that were left out of them, in Markdown.

    Log density of their coefficients [nats a mirror], above the Gaussian's that is estimated from the same others.
    """
    gauss: list[float] = []
    generic = generic_prior(np.tile(MEASURED_FACET, (4, 1)))
    names = ("Gaussian, one scale a mirror", "a scale for each group", "generic, a scale for each group")
    found: dict[str, list[float]] = {name: [] for name in names}
    for left_out, surface in enumerate(surfaces):
        prior = estimate(np.delete(surfaces, left_out, axis=0))
        gauss.append(_nats(prior, surface, (), np.inf))
        found["Gaussian, one scale a mirror"].append(_nats(prior, surface, (0,), FREEDOM))
        found["a scale for each group"].append(_nats(prior, surface, GROUPS, FREEDOM))
        found["generic, a scale for each group"].append(_nats(generic, surface, GROUPS, FREEDOM))
    rng = np.random.default_rng(0)
    rows = []
    for name, values in found.items():
        gain = np.array(values) - np.array(gauss)
        low, high = np.quantile(gain[rng.integers(len(gain), size=(4000, len(gain)))].mean(axis=1), (0.05, 0.95))
        rows.append(
            f"| {name} | {gain.mean():.0f} [{low:.0f}, {high:.0f}] | {np.median(gain):.0f} | {(gain > 0).mean():.0%} |"
        )
    head = ["| prior | mean gain over the Gaussian [nats a mirror], 90 % | median | mirrors it is better for |"]
    return "\n".join([*head, "| --- | --- | --- | --- |", *rows])


def _nats(prior: SurfacePrior, surface: Array, groups: Sequence[int], freedom: float) -> float:
    """Logarithm of the density of a surface (4, 8, 8) [m] in its `SPAN` longest directions."""
    c = prior.coefficients(surface)[:SPAN]
    size = float(np.log((prior.basis[:SPAN] ** 2).sum(axis=(1, 2, 3))).sum()) / 2
    if not groups:
        return float(-(c @ c + SPAN * np.log(2 * np.pi)) / 2) - size
    counts = np.diff([*groups, SPAN])
    squares = np.add.reduceat(c**2, groups)
    each = gammaln((freedom + counts) / 2) - gammaln(freedom / 2) - counts / 2 * np.log(freedom * np.pi)
    return float((each - (freedom + counts) / 2 * np.log1p(squares / freedom)).sum()) - size


def main() -> None:
    """Write the prior of a run's training heliostats, or compare priors."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--run", type=Path, default=Path("runs/best"))
    parser.add_argument("--out", type=Path, default=PRIOR)
    parser.add_argument(
        "--compare", type=Path, metavar="DATA", help="print what priors say of mirrors left out of them"
    )
    parser.add_argument("--generic", type=Path, metavar="DATA", help="print the generic prior's most probable numbers")
    arguments = parser.parse_args()
    if arguments.generic is not None:
        surfaces, names = load_part(arguments.generic, "training")
        print(f"{len(names)} measured mirrors: {generic_kind(surfaces)}")
        return
    if arguments.compare is not None:
        surfaces, names = load_surfaces(arguments.compare)
        apart = split(names)["apart"]
        chosen = [i for i in range(len(names)) if i not in apart]
        print(f"{len(chosen)} measured mirrors, each left out in turn; without {', '.join(names[i] for i in apart)}")
        print(compare(surfaces[chosen]))
        return
    config = TrainConfig.read(arguments.run / "config.json")
    surfaces, names = load_surfaces(Path(config.data))
    train, _ = config.parts(names)
    prior = estimate(surfaces[train])
    arrays = {name: getattr(prior, name).astype(np.float32) for name in ("mean", "basis", "hidden")}
    np.savez_compressed(arguments.out, **arrays)
    print(f"{arguments.out}: {len(prior.basis)} directions")


if __name__ == "__main__":
    main()
