"""Estimate the surface prior that ships: ``python -m training.prior --run runs/best``.

``--compare ../shared/stj`` prints which prior predicts held-out mirrors best. ``--generic
../shared/stj`` prints the generic prior's parameters with the highest likelihood of the training
mirrors.
"""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import gammaln
from scipy.stats import bootstrap

from model.checksums import digests
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
"""Weight of the covariance that treats facets as independent samples of one kind (`shrunk`)."""

SPAN = 246
"""Number of directions for the comparison of priors; all priors have as many."""

FLOOR = 7e-6
"""Independent standard deviation [m] of each control point.

The covariance of some forty mirrors cannot show it. It is small, but it affects slopes and so
images: without it, one to two percent of an image's peak are wrong.
"""


def estimate(surfaces: Array) -> SurfacePrior:
    """Estimate mean and covariance of measured surfaces (N, 4, 8, 8) [m].

    A tilt of the whole mirror is stored separately, because no image can show it.
    """
    mean = surfaces.mean(axis=0)
    measured = principal(shrunk(surfaces - mean) + FLOOR**2 * np.eye(mean.size), len(mean))
    directions = untilted(np.concatenate([measured, canting_directions()]))
    basis = orthogonal(directions - directions.mean(axis=(2, 3), keepdims=True))
    return SurfacePrior(untilted(mean), basis, tilts(surfaces))


def tilts(surfaces: Array) -> Array:
    """Tilts of the whole mirror along x and y (2, 4, 8, 8) [m].

    The size of each tilt is its root mean square in the surfaces.
    """
    modes = np.repeat(tilt_modes()[:, None], 4, axis=1)
    slopes = surfaces.reshape(len(surfaces), -1) @ np.linalg.pinv(modes.reshape(2, -1))
    return np.asarray(np.sqrt((slopes**2).mean(axis=0))[:, None, None, None] * modes)


def shrunk(deviations: Array, share: float = FACET_SHARE) -> Array:
    """Covariance (256, 256) [m2] of deviations (N, 4, 8, 8) [m] from the mean.

    A mirror is as likely as its mirror images. So the surfaces also count mirrored, turned by 180
    degrees, and both. Some forty mirrors still span few of 256 dimensions, and a new mirror lies
    outside of them. Their facets are four times as many samples of 64 dimensions. The result is a
    weighted mean of both covariances, as in shrinkage estimates (Ledoit and Wolf 2004). Equal
    weights fit held-out mirrors best.
    """
    seen = with_symmetries(deviations).reshape(-1, 256)
    whole = seen.T @ seen / len(seen)
    facets = np.zeros_like(whole)
    for facet in range(4):
        rows = slice(64 * facet, 64 * facet + 64)
        # The symmetric copies move every facet to every position, so each block is already a mean
        # over facets.
        facets[rows, rows] = whole[rows, rows]
    return np.asarray((1 - share) * whole + share * facets)


def canting_directions(sigma_mrad: float = 0.6) -> Array:
    """Free canting of each facet (8, 4, 8, 8) [m].

    Slopes along x and y are ``sigma_mrad``. A facet's canting is set by hand, and for a nominal
    focus that is not always the real one. The sample of measured heliostats does not show all of
    this variation.
    """
    free = np.zeros((4, 2, 4, 8, 8))
    for facet in range(4):
        free[facet, :, facet] = sigma_mrad * 1e-3 * tilt_modes()
    return free.reshape(8, 4, 8, 8)


def generic_kind(surfaces: Array) -> FacetKind:
    """The kind of facets with the highest likelihood of mirrors (N, 4, 8, 8) [m].

    The likelihood is independent of the mirrors' tilts and the facets' means.
    """
    flat = surfaces.reshape(len(surfaces), -1)
    unseen = np.concatenate(
        [
            np.repeat(tilt_modes()[:, None], 4, axis=1).reshape(2, -1),
            np.kron(np.eye(4), np.ones(64)),
        ]
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
    found = minimize(
        improbability,
        logs,
        method="Nelder-Mead",
        options={"initial_simplex": simplex, "xatol": 0.01},
    )
    return kind(found.x)


def compare(surfaces: Array) -> str:
    """Compare priors by held-out mirrors (N, 4, 8, 8) [m], as a Markdown table.

    The measure is the log density of the mirror's coefficients [nats per mirror], minus that of the
    Gaussian prior from the same other mirrors.
    """
    gauss: list[float] = []
    generic = generic_prior(np.tile(MEASURED_FACET, (4, 1)))
    names = (
        "Gaussian, one scale a mirror",
        "a scale for each group",
        "generic, a scale for each group",
    )
    found: dict[str, list[float]] = {name: [] for name in names}
    for left_out, surface in enumerate(surfaces):
        prior = estimate(np.delete(surfaces, left_out, axis=0))
        gauss.append(_nats(prior, surface, (), np.inf))
        found["Gaussian, one scale a mirror"].append(_nats(prior, surface, (0,), FREEDOM))
        found["a scale for each group"].append(_nats(prior, surface, GROUPS, FREEDOM))
        found["generic, a scale for each group"].append(_nats(generic, surface, GROUPS, FREEDOM))
    rows = []
    for name, values in found.items():
        gain = np.array(values) - np.array(gauss)
        low, high = bootstrap(
            (gain,), np.mean, n_resamples=4000, confidence_level=0.9, method="percentile", rng=0
        ).confidence_interval
        rows.append(
            f"| {name} | {gain.mean():.0f} [{low:.0f}, {high:.0f}] | {np.median(gain):.0f} |"
            f" {(gain > 0).mean():.0%} |"
        )
    head = [
        "| prior | mean gain over the Gaussian [nats a mirror], 90 % | median | mirrors it is"
        " better for |"
    ]
    return "\n".join([*head, "| --- | --- | --- | --- |", *rows])


def _nats(prior: SurfacePrior, surface: Array, groups: Sequence[int], freedom: float) -> float:
    """Log density of a surface (4, 8, 8) [m] in the prior's first `SPAN` directions."""
    c = prior.coefficients(surface)[:SPAN]
    size = float(np.log((prior.basis[:SPAN] ** 2).sum(axis=(1, 2, 3))).sum()) / 2
    if not groups:
        return float(-(c @ c + SPAN * np.log(2 * np.pi)) / 2) - size
    counts = np.diff([*groups, SPAN])
    squares = np.add.reduceat(c**2, groups)
    each = (
        gammaln((freedom + counts) / 2)
        - gammaln(freedom / 2)
        - counts / 2 * np.log(freedom * np.pi)
    )
    return float((each - (freedom + counts) / 2 * np.log1p(squares / freedom)).sum()) - size


def main() -> None:
    """Write the prior of a run's training heliostats, or compare priors."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--run", type=Path, default=Path("runs/best"))
    parser.add_argument("--out", type=Path, default=PRIOR)
    parser.add_argument(
        "--compare",
        type=Path,
        metavar="DATA",
        help="print what priors say of mirrors left out of them",
    )
    parser.add_argument(
        "--generic",
        type=Path,
        metavar="DATA",
        help="print the generic prior's most probable numbers",
    )
    arguments = parser.parse_args()
    if arguments.generic is not None:
        surfaces, names = load_part(arguments.generic, "training")
        print(f"{len(names)} measured mirrors: {generic_kind(surfaces)}")
        return
    if arguments.compare is not None:
        surfaces, names = load_surfaces(arguments.compare)
        apart = split(names)["apart"]
        chosen = [i for i in range(len(names)) if i not in apart]
        print(
            f"{len(chosen)} measured mirrors, each left out in turn; without"
            f" {', '.join(names[i] for i in apart)}"
        )
        print(compare(surfaces[chosen]))
        return
    config = TrainConfig.read(arguments.run / "config.json")
    surfaces, names = load_surfaces(Path(config.data))
    train, _ = config.parts(names)
    prior = estimate(surfaces[train])
    arrays = {name: getattr(prior, name).astype(np.float32) for name in ("mean", "basis", "hidden")}
    np.savez_compressed(arguments.out, **arrays)
    card = {
        "name": arguments.out.stem,
        **digests(arguments.out),
        "estimated_from": [names[i] for i in train],
    }
    arguments.out.with_suffix(".json").write_text(
        json.dumps(card, indent=1) + "\n", encoding="utf-8"
    )
    print(f"{arguments.out}: {len(prior.basis)} directions")


if __name__ == "__main__":
    main()
