"""Accuracies of the demonstration: ``python -m benchmarks.demo [--data ../shared/stj]``.

Runs ``heliotwin demo`` on the embedded plants, whose mirrors are known, or on a folder of real
photographs.
"""

import argparse
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.console import Console

from benchmarks.record import log_row, recording
from heliotwin.cli.demo import run_demos


def main(data: Path | None) -> None:
    """Run the demonstration, which prints its table."""
    with tempfile.TemporaryDirectory() as out:
        report: Mapping[str, Any] = run_demos(
            data, None, Path(out) / "demo", Console(), has_field=False
        )
    other = report.get("other_plant", {"heliostats": []})
    for one in [*report["heliostats"], *other["heliostats"]]:
        methods = ("ideal", "network", "refined", "measured")
        cells = {f"accuracy, {method}": one[f"accuracy_{method}"] for method in methods}
        cells |= {f"error, {name} [mm]": one[f"error_{name}_mm"] for name in ("network", "refined")}
        cells = {name: value for name, value in cells.items() if value is not None}
        row = f"{one['heliostat']}, judged by {one['judged']}"
        log_row(
            "The demonstration",
            row if one["held_out"] else f"{row} of the same",
            cells,
            n=one["used"],
            of="photographs used",
            compared_with="photographs and measured surfaces",
        )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, help="a measurement folder")
    folder = parser.parse_args().data
    with recording("demo" if folder is None else f"demo-{folder.name}"):
        main(folder)
