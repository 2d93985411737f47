r"""Cross-validation over held-out mirrors: ``python -m training.crossvalidate``.

There are few measured surfaces, so the results depend on which mirrors are held out. Every
heliostat is held out in one fold. The mean surface and the prior are estimated from the others, and
refinement starts from that mean. A network takes an hour to train. Networks are cross-validated
only if all folds have been trained, fold K by::

    python -m training.train --config training/configs/best.json --fold K --folds 5 \
        --run runs/fold-K
"""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from training.cases import make_cases
from training.config import TrainConfig
from training.figures import Figures, markdown, outcomes_of
from training.methods import Method, always, by_network, by_refinement, held_out_of
from training.prior import estimate
from training.render import CleanCamera, load_field
from training.surfaces import fold_of, load_surfaces

Array = NDArray[np.float64]

ROWS: dict[str, Callable[[Figures], float | None]] = {
    "error, median [mm]": lambda f: f.mae_mm["median"],
    "error, mean [mm]": lambda f: f.mae_mm["mean"],
    "flux accuracy at new suns, mean": lambda f: f.flux_accuracy,
    "the same 18 m west and 15 m higher, mean": lambda f: f.flux_accuracy_elsewhere,
    "share of cases of less accuracy than the ideal surface's": lambda f: f.worse_than_ideal,
    "share of heights within their 90 % intervals": lambda f: f.covered,
}


def methods_of(surfaces: Array, network: Path | None) -> dict[str, Method]:
    """Methods to cross-validate, estimated from one fold's training surfaces (N, 4, 8, 8) [m]."""
    mean = surfaces.mean(axis=0)
    methods = {"ideal surface": always(np.zeros_like(mean)), "mean surface": always(mean)}
    if network is not None:
        methods["network"] = by_network(network)
    return {**methods, "refinement from the mean": by_refinement(always(mean), estimate(surfaces))}


def validate(
    data: Path, fold: int, folds: int, places: int, network: Path | None
) -> dict[str, Figures]:
    """Results of each method on one fold.

    Each mirror of the fold is placed at ``places`` positions of the field.
    """
    surfaces, names = load_surfaces(data)
    train, held_out = fold_of(names, fold, folds)
    apart = [names[i] for i in held_out]
    if network is not None and (seen := set(apart) - set(held_out_of(network))):
        raise SystemExit(
            f"{network} has learnt from {', '.join(sorted(seen))}, which fold {fold} holds out"
        )
    count = places * len(held_out)
    cases = make_cases(
        surfaces[held_out], apart, load_field(data), count, CleanCamera(), seed=1000 + fold
    )
    outcomes = {
        name: outcomes_of(m, cases) for name, m in methods_of(surfaces[train], network).items()
    }
    return {name: Figures.of(found, outcomes["ideal surface"]) for name, found in outcomes.items()}


def table(folds: list[dict[str, Figures]]) -> str:
    """Means over the folds and standard deviations between them, as a Markdown table."""
    rows = []
    for row, get in ROWS.items():
        values = [[v for fold in folds if (v := get(fold[name])) is not None] for name in folds[0]]
        rows.append(
            [row, *(f"{np.mean(v):.3f} ± {np.std(v, ddof=1):.3f}" if v else "" for v in values)]
        )
    return markdown([f"mean ± standard deviation of {len(folds)} folds", *folds[0]], rows)


def main() -> None:
    """Print the table, and what it does not cross-validate."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=Path(TrainConfig().data))
    parser.add_argument(
        "--runs", type=Path, default=Path("runs"), help="where the networks' fold-K lie"
    )
    parser.add_argument("--folds", type=int, default=5)
    parser.add_argument("--places", type=int, default=1, help="in the field, for each mirror")
    arguments = parser.parse_args()
    count = arguments.folds
    networks: list[Path | None] = [arguments.runs / f"fold-{fold}" for fold in range(count)]
    if not all(run is not None and (run / "checkpoint.pt").is_file() for run in networks):
        networks = [None] * count
    folds = []
    for fold, network in enumerate(networks):
        print(f"fold {fold} ...", file=sys.stderr, flush=True)
        folds.append(validate(arguments.data, fold, count, arguments.places, network))
    print(table(folds))
    print(
        "Cross-validated: mean surface, prior, refinement"
        + ("." if networks[0] is None else ", network.")
    )
    if networks[0] is None:
        print(
            f"Not cross-validated: the network, as {arguments.runs} does not hold fold-0 to"
            f" fold-{count - 1}."
        )


if __name__ == "__main__":
    main()
