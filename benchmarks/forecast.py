"""Forecasts against photographs: ``python -m benchmarks.forecast``.

Every real ``flux.png`` of AA39 and AC43 in a 6 m window with measured and with ideal surfaces, no
effect added; and the sets of ``../shared/undeclared`` as declared, in the window that their spots
need.
"""

import tempfile
from pathlib import Path

import numpy as np

from benchmarks import data_folder
from benchmarks.record import Estimate, log_row, recording
from heliotwin.folder_forecast import forecast_folder
from service.sources.folder import read_folder

GOAL = ">= 0.855"
"""Mean accuracy by the measured surfaces of AA39 and AC43."""


def accuracies(
    root: Path, surfaces: str, heliostats: list[str] | None, window: float | None
) -> np.ndarray:
    """Flux accuracy of every measurement that has a measured flux."""
    with tempfile.TemporaryDirectory() as out:
        report = forecast_folder(read_folder(root, heliostats), Path(out), surfaces, window)
    return np.array(
        [entry["accuracy"] for entry in report["measurements"].values() if "accuracy" in entry]
    )


def main() -> None:
    """Print mean, median and extremes of the accuracy."""
    root = data_folder()
    if not root.is_dir():
        print(f"forecast: no real measurements at {root}; set HELIOTWIN_STJ")
        return
    rows = {
        f"AA39 and AC43, {surfaces} surfaces, 6 m window": accuracies(
            root, surfaces, ["AA39", "AC43"], 6.0
        )
        for surfaces in ("measured", "ideal")
    }
    for folder in sorted((root.parent / "undeclared").glob("set-*")):
        rows[f"undeclared {folder.name}, measured surfaces"] = accuracies(
            folder, "measured", None, None
        )
    print("Flux accuracy of forecasts, no effect added")
    for name, values in rows.items():
        figures = (
            f"mean {values.mean():.3f}  median {np.median(values):.3f}  min {values.min():.3f}"
        )
        print(f"  {name:<48} {figures}  max {values.max():.3f}  of {len(values)} images")
        goal = GOAL if name.startswith("AA39 and AC43, measured") else None
        log_row(
            "Flux accuracy of forecasts, no effect added",
            name,
            {
                "mean": Estimate(values.mean(), goal=goal),
                "median": np.median(values),
                "lowest": values.min(),
                "highest": values.max(),
            },
            n=len(values),
            of="images",
            compared_with="measured flux images",
        )


if __name__ == "__main__":
    with recording("forecast"):
        main()
