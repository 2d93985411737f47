"""Where the sun is seen at recorded times, against recorded suns.

    python -m benchmarks.sun [--data ../shared/stj-pointing ...]

The second table sends the light of each measurement's mirror to its spot by motors for the sun at
its time, and says how many steps those are from motors for the recorded sun, and how far from the
spot the recorded sun's light lands.
"""

import argparse
import time
from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks import data_folder
from benchmarks.pointing import Plant
from benchmarks.record import Estimate, log_row, recording
from model.ephemeris import TOLERANCE_DEG, clock_faults, sun_positions
from model.frames import sun_direction
from model.pointing import pointing_error
from model.pointing.spots import find_motors
from service.sources.documents import Measurement
from service.sources.folder import MeasurementFolder, read_folder

Array = NDArray[np.float64]

BANDS_DEG = ((0, 10), (10, 20), (20, 90), (0, 90))
"""Elevations of the sun, each a row."""


def dated(folder: MeasurementFolder) -> list[tuple[Measurement, datetime]]:
    """Measurements of a folder that have a time."""
    every = (
        one
        for name in folder.plant.heliostats
        for one in folder.measurements(name, with_images=False)
    )
    return [(one, one.taken_at) for one in every if one.taken_at is not None]


def apart_mrad(
    folder: MeasurementFolder, measurements: Sequence[tuple[Measurement, datetime]]
) -> Array:
    """Angles (N,) [mrad] between recorded suns and where the sun was seen at the recorded times."""
    angles = sun_positions([moment for _, moment in measurements], folder.plant.origin)
    recorded = np.array([one.to_sun for one, _ in measurements])
    chords = np.linalg.norm(sun_direction(angles[:, 0], angles[:, 1]) - recorded, axis=1)
    return np.asarray(2e3 * np.arcsin(chords / 2))


def suns(folder: MeasurementFolder, measurements: Sequence[tuple[Measurement, datetime]]) -> None:
    """Print how far suns at recorded times lie from recorded suns, and how many times a clock's
    check would flag.
    """
    apart, elevations = (
        apart_mrad(folder, measurements),
        np.array([one.sun.elevation_deg for one, _ in measurements]),
    )
    print("| elevation [deg] | suns | median [mrad] | 95 % | largest |")
    print("| --- | --- | --- | --- | --- |")
    for low, high in BANDS_DEG:
        own = apart[(elevations >= low) & (elevations < high)]
        if len(own):
            figures = np.median(own), np.quantile(own, 0.95), own.max()
            print(
                f"| {low} to {high} | {len(own)} |"
                f" {' | '.join(f'{figure:.3f}' for figure in figures)} |"
            )
            goal = "<= 0.05" if (low, high) == BANDS_DEG[-1] else None
            cells = {"median [mrad]": Estimate(figures[0], goal=goal)}
            cells |= {"95 % [mrad]": Estimate(figures[1]), "largest [mrad]": Estimate(figures[2])}
            log_row(
                "Sun at a time, by the sun's elevation",
                f"{low} to {high} degrees",
                cells,
                n=len(own),
                of="suns",
                compared_with="recorded suns",
            )
    moments = [moment for _, moment in measurements]
    flagged = clock_faults(
        np.array([one.to_sun for one, _ in measurements]), moments, folder.plant.origin
    )
    beyond = sum(one is not None for one in flagged)
    print(f"beyond the clock's tolerance of {TOLERANCE_DEG} degrees: {beyond}")
    log_row(
        "Times that the clock check flags",
        "recorded suns",
        {"flagged": beyond},
        n=len(apart),
        of="suns",
    )


def motors(plant: Plant, folder: MeasurementFolder) -> None:
    """Print how far motors and light move by the sun at the time in place of the recorded one."""
    moments = {one.key: moment for one, moment in dated(folder)}
    calibrated, _ = plant.calibrate(plant.readings)
    steps, lands = [], []
    for name, mount in calibrated.items():
        heliostat = plant.heliostats[name]
        own = [
            (one, moments[f"{name}/{one.name}"])
            for one in plant.readings[name]
            if f"{name}/{one.name}" in moments
        ]
        suns_then = sun_positions([moment for _, moment in own], folder.plant.origin)
        for (one, _), angles in zip(own, suns_then, strict=True):
            by_time, recorded = (
                find_motors(mount, heliostat, sun, one.spot, one.day)
                for sun in (sun_direction(*angles), one.sun)
            )
            steps.append(np.abs(by_time - recorded).max())
            lands.append(1e3 * pointing_error(heliostat, mount, [replace(one, motors=by_time)])[0])
    print(f"| {len(steps)} measurements | median | 95 % | largest |")
    print("| --- | --- | --- | --- |")
    for label, values in (
        ("motors, the axis that differs more [steps]", steps),
        ("where the light lands [mrad]", lands),
    ):
        print(
            f"| {label} | {np.median(values):.2f} | {np.quantile(values, 0.95):.2f} |"
            f" {np.max(values):.2f} |"
        )
        cells = {"median": np.median(values), "95 %": np.quantile(values, 0.95)}
        log_row(
            "Motors and light by the sun at a time",
            label,
            cells | {"largest": np.max(values)},
            n=len(values),
            of="measurements",
            compared_with="motors for the recorded sun",
        )


def speed(folder: MeasurementFolder) -> None:
    """Print the processor time of one sun and of a day's."""
    start = datetime.fromisoformat("2026-06-21T00:00:00+00:00").timestamp()
    for count in (1, 96, 1000):
        moments = [
            datetime.fromtimestamp(start + 900 * place).astimezone() for place in range(count)
        ]
        began = time.process_time()
        for _ in range(20):
            sun_positions(moments, folder.plant.origin)
        taken_ms = (time.process_time() - began) / 20 * 1e3
        print(f"{count} suns: {taken_ms:.1f} ms")
        log_row("Processor time", f"{count} suns", {"time [ms]": taken_ms}, n=20, of="repeats")


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--data", type=Path, nargs="+", default=[data_folder().parent / "stj-pointing"]
    )
    for path in parser.parse_args().data:
        folder = read_folder(path)
        measurements = dated(folder)
        print(f"{path.name}: {len(measurements)} recorded suns with a time\n")
        suns(folder, measurements)
        print()
        motors(Plant([path]), folder)
        print()
        speed(folder)


if __name__ == "__main__":
    with recording("sun"):
        main()
