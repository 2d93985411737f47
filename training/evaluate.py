"""Evaluate predictions of unseen surfaces, as in the paper: ``python -m training.evaluate``.

The measured surfaces of the test mirrors (`training.surfaces.SPLIT`) are placed in the field
(`training.cases`) and photographed. They are predicted from their images and traced again under new
suns. The network and the refinement are compared with the ideal surface and with the mean surface
of the other heliostats. The mean surface is already close to the truth: a network that is not
clearly better has learnt nothing. The refinement with the generic prior starts from the ideal
surface and uses no measured surface. Intervals are 90 % bootstrap intervals over mirrors.

Tables in Markdown are printed. ``out/evaluation`` receives the tables, every case's outcome and the
plots.
"""

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from model.network.architecture import MAX_IMAGES
from model.network.predictor import WEIGHTS
from model.prior import MEASURED_FACET, default_prior, generic_prior
from training import plots
from training.cases import Case, make_cases
from training.config import TrainConfig
from training.figures import Figures, Outcome, markdown, median_error, outcomes_of, shown
from training.methods import Method, always, by_network, by_refinement, held_out_of
from training.render import CleanCamera, RealCamera, load_field
from training.surfaces import load_part

Array = NDArray[np.float64]

PAPER = "paper (Lewen et al. 2024)"
REFINEMENT = "refinement"
GENERIC = "refinement, generic prior"
SLOW = (REFINEMENT, GENERIC)

DISTANCES = (0, 75, 125, 200, 300)
"""Edges [m] of the distance bins."""


@dataclass(frozen=True)
class NetworkEvaluation:
    """All results, by method; the series hold median errors [mm].

    ``over_distance`` has a value for each bin of `DISTANCES`. ``over_inputs`` has a value for 1 to
    8 images of the first ``few`` cases. Refinement takes seconds, so it is evaluated only on these
    cases.
    """

    outcomes: dict[str, list[Outcome]]
    over_inputs: dict[str, list[float]]
    few: int

    @property
    def figures(self) -> dict[str, Figures]:
        """Results of each method; the ideal surface is the first."""
        ideal = next(iter(self.outcomes.values()))
        return {name: Figures.of(found, ideal) for name, found in self.outcomes.items()}

    @property
    def over_distance(self) -> dict[str, list[float]]:
        """Median errors [mm] in each bin; NaN if a bin has no case."""
        return {name: _by_distance(found) for name, found in self.outcomes.items()}

    def tables(self) -> str:
        """Results, errors over distance, and errors over the number of images, in Markdown."""
        ranges = [f"{low} to {high}" for low, high in pairwise(DISTANCES)]
        images = [str(n) for n in range(1, MAX_IMAGES + 1)]
        return "\n".join(
            [
                self._figures_table(),
                _series_table("distance [m]: median error [mm]", ranges, self.over_distance),
                _series_table(
                    f"images: median error of {self.few} cases [mm]", images, self.over_inputs
                ),
            ]
        )

    def _figures_table(self) -> str:
        figures = self.figures

        def row(
            name: str, get: Callable[[Figures], float | None], paper: str = "", form: str = ".3f"
        ) -> list[str]:
            return [name, *(shown(get(f), form) for f in figures.values()), paper]

        def error(name: str) -> list[str]:
            return row(f"error, {name} [mm]", lambda f: f.mae_mm[name])

        def within(f: Figures) -> str:
            return shown(f.covered, ".1%", f.covered_90)

        rows = [
            row("cases", lambda f: f.cases, form=".0f"),
            [
                "error, median [mm]",
                *(shown(f.mae_mm["median"], between=f.median_90) for f in figures.values()),
                "0.14",
            ],
            *(error(name) for name in ("mean", "min", "q1", "q3", "max")),
            row(
                "flux accuracy at new suns, median",
                lambda f: f.flux_accuracy_median,
                "0.92 (ideal surface 0.67)",
            ),
            row("flux accuracy at new suns, mean", lambda f: f.flux_accuracy),
            row("the same 18 m west and 15 m higher, mean", lambda f: f.flux_accuracy_elsewhere),
            row(
                "cases of less accuracy than the ideal surface's",
                lambda f: f.worse_than_ideal,
                form=".1%",
            ),
            ["heights within their 90 % intervals", *(within(f) for f in figures.values()), ""],
        ]
        return markdown(["", *figures, PAPER], rows)


def _by_distance(outcomes: Sequence[Outcome]) -> list[float]:
    bins = np.digitize([o.distance_m for o in outcomes], DISTANCES[1:-1])
    errors = np.array([o.mae_mm for o in outcomes])
    return [
        float(np.median(errors[bins == b])) if (bins == b).any() else np.nan
        for b in range(len(DISTANCES) - 1)
    ]


def _series_table(name: str, steps: Sequence[str], series: dict[str, list[float]]) -> str:
    rows = [
        [step, *(shown(values[i]) for values in series.values())] for i, step in enumerate(steps)
    ]
    return markdown([name, *series], rows)


def evaluate(
    methods: dict[str, Method], cases: list[Case], few: int, fewest: int = 1
) -> NetworkEvaluation:
    """Evaluate all methods on all cases; the ideal surface must be the first method.

    Refinement, and fewer images, are evaluated on the first ``few`` cases. Numbers of images below
    ``fewest`` are skipped.
    """
    outcomes: dict[str, list[Outcome]] = {}
    inputs: dict[str, list[float]] = {}
    for name, method in methods.items():
        print(f"{name} ...", file=sys.stderr, flush=True)
        outcomes[name] = outcomes_of(method, cases[:few] if name in SLOW else cases)
        fewer = [
            median_error(method, cases[:few], images) if images >= fewest else np.nan
            for images in range(1, MAX_IMAGES)
        ]
        inputs[name] = [*fewer, float(np.median([o.mae_mm for o in outcomes[name][:few]]))]
    return NetworkEvaluation(outcomes, inputs, few)


def compared(network: Path, beside: Path | None, mean: Array) -> dict[str, Method]:
    """All methods of the comparison; ``beside`` are other weights, if any."""
    best = by_network(network)
    return {
        "ideal surface": always(np.zeros_like(mean)),
        "mean surface": always(mean),
        **({} if beside is None else {f"network {beside.stem}": by_network(beside)}),
        "network, one look": by_network(network, n_iterations=1),
        "network": best,
        REFINEMENT: by_refinement(best),
        GENERIC: by_refinement(
            always(np.zeros_like(mean)), generic_prior(np.tile(MEASURED_FACET, (len(mean), 1)))
        ),
    }


def draw(
    evaluation: NetworkEvaluation, methods: dict[str, Method], cases: list[Case], out: Path
) -> None:
    """Plot errors over distance and over images, and surfaces of three cases.

    These are the best, the median and the worst case of the refinement.
    """
    middle = [(low + high) / 2 for low, high in pairwise(DISTANCES)]
    images = range(1, MAX_IMAGES + 1)
    over_distance = {name: (middle, errors) for name, errors in evaluation.over_distance.items()}
    over_images = {name: (images, errors) for name, errors in evaluation.over_inputs.items()}
    error = "median error of control heights [mm]"
    plots.lines(over_distance, "distance [m]", error).savefig(out / "error-over-distance.png")
    plots.lines(over_images, "images", error).savefig(out / "error-over-images.png")
    order = np.argsort([o.mae_mm for o in evaluation.outcomes[REFINEMENT]])
    rows = {}
    for rank, index in zip(
        ("best", "median", "worst"), order[[0, len(order) // 2, -1]], strict=True
    ):
        case = cases[index]
        predicted = {name: methods[name](case, MAX_IMAGES)[0] for name in ("network", REFINEMENT)}
        rows[f"{rank}: {case.surface}, {case.distance:.0f} m"] = {
            "deflectometry": case.truth,
            **predicted,
        }
    plots.surfaces(rows).savefig(out / "surfaces.png")


def main() -> None:
    """Evaluate; print and write the tables, and write every outcome and the plots."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=Path(TrainConfig().data))
    parser.add_argument(
        "--network",
        type=Path,
        default=WEIGHTS,
        help="an ONNX file beside its card, or a run's folder",
    )
    parser.add_argument("--beside", type=Path, help="other weights, likewise, to be compared with")
    parser.add_argument("--cases", type=int, default=128)
    parser.add_argument(
        "--refined",
        type=int,
        default=24,
        help="how many cases are refined, from 1 to 8 images each",
    )
    parser.add_argument(
        "--fewest", type=int, default=1, help="images from which on cases are predicted, to 8"
    )
    parser.add_argument("--camera", choices=("clean", "imperfect"), default="clean")
    parser.add_argument("--out", type=Path, default=Path("out/evaluation"))
    arguments = parser.parse_args()
    surfaces, names = load_part(arguments.data, "test")
    for network in filter(None, (arguments.network, arguments.beside)):
        if seen := set(names) - set(held_out_of(network)):
            parser.error(
                f"{network} has learnt from {', '.join(sorted(seen))}, which are to judge it"
            )
    camera = CleanCamera() if arguments.camera == "clean" else RealCamera()
    cases = make_cases(surfaces, names, load_field(arguments.data), arguments.cases, camera)
    methods = compared(arguments.network, arguments.beside, default_prior().mean)
    evaluation = evaluate(
        methods, cases, min(max(arguments.refined, 1), len(cases)), arguments.fewest
    )
    arguments.out.mkdir(parents=True, exist_ok=True)
    (arguments.out / "evaluation.md").write_text(evaluation.tables(), encoding="utf-8")
    found = {"network": str(arguments.network), "camera": arguments.camera, **asdict(evaluation)}
    found["figures"] = {name: asdict(figures) for name, figures in evaluation.figures.items()}
    (arguments.out / "evaluation.json").write_text(
        json.dumps(found, indent=1) + "\n", encoding="utf-8"
    )
    draw(evaluation, methods, cases, arguments.out)
    print(evaluation.tables())


if __name__ == "__main__":
    main()
