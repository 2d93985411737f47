"""Figures of the programs of `training`: ``python -m benchmarks.training PROGRAM ..``.

The program (``evaluate``, ``crossvalidate``, ``prior``, ``fit``) runs with the arguments that
follow, as ``python -m training.PROGRAM`` does, and prints what it prints. Its figures are recorded,
too. ``card`` records the figures of the shipped weights' model card.
"""

import json
import re
import sys
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.record import Estimate, log_row, recording
from model.network.predictor import WEIGHTS
from training import crossvalidate, evaluate, fit, prior

GOALS = {
    "clean": {},
    "imperfect": {
        "network": "<= 0.11",
        evaluate.REFINEMENT: "<= 0.05",
        evaluate.GENERIC: "<= 0.12",
    },
}
"""Goals of the median error [mm] by camera and method."""

ELSEWHERE = "flux accuracy on a plane 18 m west and 15 m higher, mean"


def log_evaluation() -> None:
    """Record an evaluation."""
    evaluate.main()
    found = json.loads(Path("out/evaluation/evaluation.json").read_text(encoding="utf-8"))
    camera = found["camera"]
    goals = GOALS[camera]
    for name, figures in found["figures"].items():
        rows = {
            "error, median [mm]": Estimate(
                figures["mae_mm"]["median"], figures["median_90"], 90, goals.get(name)
            ),
            "error, mean [mm]": figures["mae_mm"]["mean"],
            "error, least [mm]": figures["mae_mm"]["min"],
            "error, greatest [mm]": figures["mae_mm"]["max"],
            "flux accuracy at new suns, median": figures["flux_accuracy_median"],
            "flux accuracy at new suns, mean": figures["flux_accuracy"],
            ELSEWHERE: figures["flux_accuracy_elsewhere"],
            "cases of less accuracy than the ideal surface's [%]": 100
            * figures["worse_than_ideal"],
        }
        if figures["covered"] is not None:
            ends = [100 * end for end in figures["covered_90"]]
            rows["heights within 90 % intervals [%]"] = Estimate(100 * figures["covered"], ends, 90)
        for row, cell in rows.items():
            log_row(
                f"Test mirrors, {camera} cameras",
                row,
                {name: cell},
                n=figures["cases"],
                of="cases",
                compared_with="the true surfaces",
            )
    distances = [f"{low} to {high} m [mm]" for low, high in pairwise(evaluate.DISTANCES)]
    for index, row in enumerate(distances):
        values = {name: _by_distance(found["outcomes"][name])[index] for name in found["figures"]}
        log_row(f"Median error over the distance, {camera} cameras", row, values)


def _by_distance(outcomes: list[dict[str, Any]]) -> list[float]:
    bins = np.digitize([one["distance_m"] for one in outcomes], evaluate.DISTANCES[1:-1])
    errors = np.array([one["mae_mm"] for one in outcomes])
    return [
        float(np.median(errors[bins == b])) if (bins == b).any() else np.nan
        for b in range(len(evaluate.DISTANCES) - 1)
    ]


def log_folds() -> None:
    """Record a cross-validation."""
    markdown = crossvalidate.table

    def table(folds: list[dict[str, Any]]) -> str:
        for row, get in crossvalidate.ROWS.items():
            values = {
                name: [v for fold in folds if (v := get(fold[name])) is not None]
                for name in folds[0]
            }
            cells = {
                name: Estimate(np.mean(some), std=float(np.std(some, ddof=1)))
                for name, some in values.items()
                if len(some) == len(folds)
            }
            title = "Held-out mirrors, mean and standard deviation between folds"
            log_row(title, row, cells, n=len(folds), of="folds", compared_with="the true surfaces")
        return markdown(folds)

    crossvalidate.table = table
    crossvalidate.main()


def log_priors() -> None:
    """Record a comparison of priors."""
    compare = prior.compare

    def logged(surfaces: Any) -> str:
        text = compare(surfaces)
        for line in text.splitlines()[2:]:
            name, gain, median, share = (cell.strip() for cell in line.strip("| ").split("|"))
            value, low, high = map(float, re.findall(r"-?\d+", gain))
            log_row(
                "Priors of the surface, each mirror left out in turn",
                name,
                {
                    "mean gain [nats a mirror]": Estimate(value, (low, high), 90),
                    "median gain [nats a mirror]": float(median),
                    "better for [%]": float(share.rstrip("%")),
                },
                n=len(surfaces),
                of="mirrors",
                compared_with="one Gaussian prior",
            )
        return text

    prior.compare = logged
    prior.main()


def log_fits() -> None:
    """Record fits of control heights to deflectometry."""
    as_text = fit.row

    def row(measured: Any, fitted: Any) -> list[str]:
        cells = as_text(measured, fitted)
        titles = [f"{title} [%]" if title == "below 0.1 mrad" else title for title in fit.HEAD]
        values = [float(cell.rstrip("%")) if cell else None for cell in cells[1:]]
        log_row(
            "Control heights fitted to deflectometry",
            cells[0],
            dict(zip(titles[2:], values[1:], strict=True)),
            n=int(cells[1]),
            of="normals",
            compared_with="measured normals",
        )
        return cells

    fit.row = row
    fit.main()


def log_card() -> None:
    """Record the model card's figures."""
    card = json.loads(WEIGHTS.with_suffix(".json").read_text(encoding="utf-8"))
    print(json.dumps(card["evaluation"], indent=1))
    for name, figures in card["evaluation"].items():
        cells = {
            "error, median [mm]": Estimate(figures["mae_mm"]["median"], figures["median_90"], 90),
            "error, mean [mm]": figures["mae_mm"]["mean"],
            "flux accuracy at new suns, median": figures["flux_accuracy_median"],
        }
        if figures["covered"] is not None:
            ends = [100 * end for end in figures["covered_90"]]
            covered = Estimate(100 * figures["covered"], ends, 90)
            cells["heights within 90 % intervals [%]"] = covered
        log_row(
            "Model card of the shipped weights",
            name,
            cells,
            n=figures["cases"],
            of="cases",
            compared_with="the true surfaces of test mirrors",
        )


PROGRAMS = {
    "evaluate": log_evaluation,
    "crossvalidate": log_folds,
    "prior": log_priors,
    "fit": log_fits,
    "card": log_card,
}


def main() -> None:
    """Run a program and record its figures."""
    if len(sys.argv) < 2 or sys.argv[1] not in PROGRAMS:
        raise SystemExit(f"usage: python -m benchmarks.training {{{','.join(PROGRAMS)}}} ..")
    program = sys.argv[1]
    camera = "imperfect" if "imperfect" in sys.argv else "clean"
    with recording(f"{program}-{camera}" if program == "evaluate" else program):
        del sys.argv[1]
        PROGRAMS[program]()


if __name__ == "__main__":
    main()
