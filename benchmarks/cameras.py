"""The watch of cameras on real photographs: ``python -m benchmarks.cameras
[../shared/stj-years]``.

Prints for each target how much days differ, and whether a change is found in the days as recorded
(no change of their cameras is known). It also prints how often a change is found in days drawn at
random from them, and how often a change by a factor on the last seven of 45 days is found.
"""

import argparse
from collections import defaultdict
from datetime import date, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.record import log_row, recording
from heliotwin.folder_store import open_folder
from service.base.settings import Settings
from service.sources.folder import read_folder
from service.twin.studies.cameras import FIGURES, CameraChange, find_camera_change

DRAWS, LONG, DAYS, LAST = 200, 60, 45, 7
FACTORS = (1.5, 2.0, 3.0)


def medians(root: Path) -> dict[str, dict[date, Any]]:
    """The medians of each day by target."""
    folder = read_folder(root)
    found: dict[str, dict[date, list[Any]]] = defaultdict(lambda: defaultdict(list))
    with open_folder(folder) as opened:
        for heliostat in opened.names:
            for row in opened.photographs(heliostat)[0]:
                if row.taken_at is not None:
                    figures = np.log([row.quality[name] for name in FIGURES])
                    found[row.target.name][row.taken_at.date()].append(figures)
    return {
        target: {day: np.median(all_, axis=0) for day, all_ in days.items()}
        for target, days in found.items()
    }


def _change(values: Any) -> CameraChange | None:
    days = {date(2024, 1, 1) + timedelta(days=number): one for number, one in enumerate(values)}
    return find_camera_change("", days, Settings())


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", nargs="?", type=Path, default=Path("../shared/stj-years"))
    rng = np.random.default_rng(1)
    print("| target | days | spread of days | as they came | by chance, 60 days |", end="")
    print(
        "".join(f" found, x {factor:g} |" for factor in FACTORS),
        "\n|",
        " --- |" * (5 + len(FACTORS)),
        sep="",
    )
    for target, by_day in sorted(medians(parser.parse_args().folder).items()):
        values = np.array([by_day[day] for day in sorted(by_day)])
        if len(values) < 15:
            continue
        alarms = 100 * np.mean(
            [_change(rng.choice(values, LONG)) is not None for _ in range(DRAWS)]
        )
        row = [
            target,
            len(values),
            values.std(axis=0).round(2).tolist(),
            find_camera_change(target, by_day, Settings()),
        ]
        row.append(f"{alarms:.1f}%")
        cells = {
            "changes in the days as recorded": int(row[-2] is not None),
            f"alarms in {LONG} days drawn by chance [%]": alarms,
        }
        for factor in FACTORS:
            drawn = (rng.choice(values, DAYS) for _ in range(DRAWS))
            step = np.log(factor) * np.outer(np.arange(DAYS) >= DAYS - LAST, (1, 0, 0))
            found = 100 * np.mean([_change(one + step) is not None for one in drawn])
            row.append(f"{found:.0f}%")
            cells[f"a factor of {factor:g} found [%]"] = found
        log_row("Cameras watched without a study", target, cells, n=len(values), of="days")
        print("|", " | ".join(map(str, row)), "|", flush=True)


if __name__ == "__main__":
    with recording("cameras"):
        main()
