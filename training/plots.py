"""Plots of training and evaluation.

``python -m training.plots`` draws the learning curves of all runs.
"""

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from model.surface import DEGREE, basis

Array = NDArray[np.float64]
Line = tuple[Sequence[float], Sequence[float]]


def lines(series: Mapping[str, Line], across: str, up: str) -> Figure:
    """Plot named lines (x, y) in one figure."""
    figure = Figure(figsize=(7, 4.5), layout="constrained")
    axes = figure.subplots()
    for name, (x, y) in series.items():
        axes.plot(x, y, marker="o", markersize=3, label=name)
    axes.set(xlabel=across, ylabel=up, ylim=(0, None))
    axes.grid(alpha=0.3)
    axes.legend()
    return figure


def surfaces(rows: Mapping[str, Mapping[str, Array]]) -> Figure:
    """Plot rows of surfaces (4, 8, 8) [m], seen from the front.

    Each row has one scale.
    """
    count = max(len(row) for row in rows.values())
    figure = Figure(figsize=(3.2 * count, 2.7 * len(rows)), layout="constrained")
    panes = figure.subplots(len(rows), count, squeeze=False)
    for line, (title, row) in zip(panes, rows.items(), strict=True):
        bound = max(float(np.abs(z).max()) for z in row.values()) * 1e3
        for axes, (name, z) in zip(line, row.items(), strict=True):
            image = axes.imshow(mirror(z) * 1e3, cmap="RdBu_r", vmin=-bound, vmax=bound, aspect=0.8)
            axes.set(xticks=[], yticks=[], title=name)
        line[0].set_ylabel(title, fontsize=8)
        figure.colorbar(image, ax=line.tolist(), label="mm")
    return figure


def mirror(z: Array, points: int = 40) -> Array:
    """Heights (2 * points, 2 * points) [m] of a surface (4, 8, 8), evenly spaced.

    The upper left corner comes first.
    """
    across, along = (basis(count, DEGREE, np.linspace(0, 1, points))[0] for count in z.shape[1:])
    # i runs to the right and j upwards; rows run downwards.
    seen = (across @ z @ along.T).transpose(0, 2, 1)[:, ::-1]
    return np.block([[seen[0], seen[1]], [seen[2], seen[3]]])


def learning_curves(runs: Sequence[Path]) -> Figure:
    """Plot errors of runs' ``curve.jsonl`` over their steps.

    The errors are on training samples, and on validation surfaces for each iteration.
    """
    series: dict[str, Line] = {}
    for run in runs:
        curve = [
            json.loads(line)
            for line in (run / "curve.jsonl").read_text(encoding="utf-8").splitlines()
        ]
        steps = [line["step"] for line in curve]
        series[f"{run.name}, training"] = (steps, [line["train_mae_mm"] for line in curve])
        for look, errors in enumerate(
            zip(*(line["validation_mae_mm"] for line in curve), strict=True), start=1
        ):
            series[f"{run.name}, validation, look {look}"] = (steps, errors)
    return lines(series, "step", "mean error of control heights [mm]")


def main() -> None:
    """Draw the curves of all runs that have one."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=Path, default=Path("runs"))
    parser.add_argument("--out", type=Path, default=Path("out/learning-curves.png"))
    arguments = parser.parse_args()
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    learning_curves(sorted(path.parent for path in arguments.runs.glob("*/curve.jsonl"))).savefig(
        arguments.out
    )
    print(arguments.out)


if __name__ == "__main__":
    main()
