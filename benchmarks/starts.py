"""Whether refinement ends where it would have ended from the truth: ``python -m
benchmarks.starts``.

Mirrors of two kinds, placed over the field and photographed eight times (`training.cases`, one per
cent of noise, 8 bits): measured ones that neither network nor prior has seen, and ones drawn from
the heavy-tailed prior, whose rough ones are rougher than any measured one. Each is refined from the
network's prediction and the prior's mean, from the mean alone, and from the truth and the mean. An
end is no worse than that from the truth if it leaves no more of the images, up to a hundredth of
what that leaves. What both leave is the images' noise, the same for both. Mirrors are of 8 x 8
heights, and are refined as such; ``--rippled`` as real ones are, with ripples that explain a part
of what heights leave.
"""

import argparse
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context

import numpy as np
from numpy.typing import NDArray

from benchmarks import data_folder
from benchmarks.record import log_row, proportion, recording
from model.metrics import surface_error
from model.network.predictor import WEIGHTS, default_predictor
from model.plant_model import JUELICH_MODEL
from model.prior import FREEDOM, GROUPS, SurfacePrior, default_prior
from model.refinement import RefinementOptions, refine
from training.cases import Case, make_cases
from training.methods import held_out_of
from training.render import CleanCamera, load_field
from training.surfaces import load_surfaces

Array = NDArray[np.float64]

NO_WORSE = 1.01
"""Share of the misfit from the truth up to which another end is no worse."""

STARTS = ("the network's prediction and the mean", "the prior's mean")


@dataclass(frozen=True)
class Ends:
    """Of one mirror, from each of `STARTS` and, last, from the truth: misfits [1] and errors [mm];
    its roughness [1].

    ``roughness`` is the root mean square of its coefficients, about one for the prior's usual
    mirror.
    """

    kind: str
    misfits: tuple[float, ...]
    errors: tuple[float, ...]
    roughness: float

    def no_worse(self, start: int) -> bool:
        """Whether the end from a start is no worse than that from the truth."""
        return self.misfits[start] <= NO_WORSE * self.misfits[-1]


def drawn(prior: SurfacePrior, count: int, rng: np.random.Generator) -> Array:
    """Mirrors (count, 4, 8, 8) [m] of the prior: Gaussian, with an inverse gamma variance for each
    group.
    """
    sizes = np.diff([*GROUPS, len(prior.basis)])
    scales = np.sqrt(FREEDOM / rng.chisquare(FREEDOM, (count, len(sizes)))).repeat(sizes, axis=1)
    return np.stack(
        [prior.surface(c) for c in scales * rng.standard_normal((count, len(prior.basis)))]
    )


def ends(kind: str, rippled: bool, case: Case) -> Ends:
    """Refine one mirror from each start."""
    options = RefinementOptions(with_ripples=rippled)
    heliostat, seen = case.heliostat, case.observations
    network = default_predictor().predict(heliostat, seen, JUELICH_MODEL).z
    starts = (network, None, case.truth)
    found = [refine(heliostat, seen, JUELICH_MODEL, z, options=options) for z in starts]
    roughness = float(np.sqrt((default_prior().coefficients(case.truth) ** 2).mean()))
    return Ends(
        kind,
        tuple(end.misfit for end in found),
        tuple(1e3 * surface_error(end.z, case.truth) for end in found),
        roughness,
    )


def main(arguments: list[str]) -> None:
    """Print the table, and every mirror that ends worse."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--each", type=int, default=50, help="mirrors of either kind")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument(
        "--rippled", action="store_true", help="seek ripples, which these mirrors do not have"
    )
    options = parser.parse_args(arguments)
    root = data_folder()
    surfaces, names = load_surfaces(root)
    apart, field = held_out_of(WEIGHTS), load_field(root)
    kinds = {
        "measured": (surfaces[[names.index(name) for name in apart]], apart),
        "drawn": (
            drawn(default_prior(), options.each, np.random.default_rng(3)),
            [""] * options.each,
        ),
    }
    print(
        "| mirrors, from | no worse than from the truth | median error [mm] | from the truth |"
        " worst |"
    )
    print("| --- | --- | --- | --- | --- |")
    everything: list[Ends] = []
    with ProcessPoolExecutor(options.jobs, mp_context=get_context("spawn")) as pool:
        for kind, (z, labels) in kinds.items():
            cases = make_cases(z, labels, field, options.each, CleanCamera(), seed=700)
            found = list(pool.map(partial(ends, kind, options.rippled), cases))
            everything += found
            errors = np.array([mirror.errors for mirror in found])
            middle, worst = np.median(errors, axis=0), errors.max(axis=0)
            for start, name in enumerate(STARTS):
                good = sum(mirror.no_worse(start) for mirror in found)
                row = (
                    f"{good} of {len(found)} | {middle[start]:.3f} | {middle[-1]:.3f} |"
                    f" {worst[start]:.3f}"
                )
                print(f"| {kind}, {name} | {row} |", flush=True)
                log_row(
                    "Refinement from several starts",
                    f"{kind} mirrors, from {name}",
                    {
                        "no worse than from the truth [%]": proportion(good, len(found), ">= 95"),
                        "error, median [mm]": middle[start],
                        "from the truth, median [mm]": middle[-1],
                        "error, worst [mm]": worst[start],
                    },
                    n=len(found),
                    of="mirrors",
                    compared_with="refinement from the truth",
                )
    for mirror in everything:
        if not all(mirror.no_worse(start) for start in range(len(STARTS))):
            figures = ", ".join(
                f"{m:.4f} ({e:.3f} mm)" for m, e in zip(mirror.misfits, mirror.errors, strict=True)
            )
            print(f"{mirror.kind}, roughness {mirror.roughness:.1f}: misfits {figures}")


if __name__ == "__main__":
    with recording("starts"):
        main(sys.argv[1:])
