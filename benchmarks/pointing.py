"""Where light lands: mounts calibrated from real photographs, judged by measurements left out, and
how fast that is.

    python -m benchmarks.pointing [--data ../shared/stj-pointing ...] [--only TABLE] [--out
    results/pointing.png]

Beam errors are angles at the heliostat between forecast and measured spot; a figure is the median
over heliostats of each one's median, with a 90 % interval from resampled heliostats. The spreads in
`model.pointing.drives.Noise` were chosen on half of the heliostats (`DEVELOPED_ON`); the table has
the other half apart.
"""

import argparse
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.stats import bootstrap

from benchmarks import data_folder
from benchmarks.folders import read_readings
from benchmarks.record import Estimate, log_row, proportion, recording
from model.frames import sun_angles
from model.plant import Heliostat, TargetPlane
from model.pointing import CalibratedMount, FieldPrior, Reading, calibrate_field, pointing_error
from model.pointing.spots import spot_covariance
from model.site import JUELICH, Site
from service.sources.folder import read_folder

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

DEVELOPED_ON = ("BE36", "BF41", "BF55", "BG14", "BG23", "BH20", "BH60", "BJ14")

# Fewer measurements than that are not split: their third would say nothing.
LEAST = 24

# Steps that are put into real series [mrad] of a drive's zero, and how many trials of each.
STEPS_MRAD = (2.0, 4.0, 8.0)
TRIALS = 40

# Times at which a clock is put wrong.
CLOCK_TRIALS = 12

# Windows of measurements that calibrate, places of the windows, and measurements that follow each.
FORWARD_KEPT, FORWARD_PLACES, FORWARD_JUDGES = (6, 12, 24, 48), 8, 4
# A heliostat has moved if it is off by more standard deviations (`service.twin.pointing_errors`).
MOVED_STD = 5.0

# How often the mounts are calibrated again as the last third comes in.
PARTS = 4

GOALS = {
    "a random third": "<= 0.8",
    "the last third in time": "<= 1.2",
    "the third of suns farthest from all others": "<= 1",
}
"""Goals of the median error [mrad] by what is left out."""

Series = dict[str, list[Reading]]


class Plant:
    """Heliostats, readings in order of time and targets of several folders of one plant."""

    def __init__(self, folders: Sequence[Path]) -> None:
        self.heliostats: dict[str, Heliostat] = {}
        self.readings: Series = {}
        self.targets: dict[str, TargetPlane] = {}
        self.site = JUELICH
        self.unusual: tuple[str, ...] = ()
        for path in folders:
            folder = read_folder(path)
            self.heliostats |= folder.plant.heliostats
            self.targets |= folder.plant.targets
            self.site = folder.model.site
            self.readings |= {
                name: sorted(own, key=lambda one: one.day)
                for name, own in read_readings(folder).items()
            }

    def calibrate(
        self, readings: Series, prior: FieldPrior | None = None
    ) -> tuple[dict[str, CalibratedMount], FieldPrior]:
        """Mounts of some readings, and the field's prior."""
        done = calibrate_field(self.heliostats, readings, self.targets, self.site, prior=prior)
        self.unusual = tuple({*self.unusual, *done.unusual})
        return done.mounts, done.prior


def random_third(own: Sequence[Reading], generator: np.random.Generator) -> NDArray[np.intp]:
    """Any third."""
    return generator.permutation(len(own))[: len(own) // 3]


def last_third(own: Sequence[Reading], _: np.random.Generator) -> NDArray[np.intp]:
    """The newest third."""
    return np.arange(len(own) - len(own) // 3, len(own))


def far_third(own: Sequence[Reading], _: np.random.Generator) -> NDArray[np.intp]:
    """The third of suns that are farthest from all others: by the mean angle to the
    three nearest.
    """
    suns = np.array([one.sun for one in own])
    apart = np.arccos(np.clip(suns @ suns.T, -1, 1))
    np.fill_diagonal(apart, np.inf)
    return np.argsort(np.sort(apart, axis=1)[:, :3].mean(axis=1))[::-1][: len(own) // 3]


def split(own: Sequence[Reading], judged: NDArray[np.intp]) -> tuple[list[Reading], list[Reading]]:
    """Readings that calibrate, and those that judge."""
    apart = set(judged.tolist())
    kept = [one for place, one in enumerate(own) if place not in apart]
    return kept, [own[place] for place in sorted(apart)]


def errors_mrad(
    plant: Plant, mounts: dict[str, CalibratedMount], judged: Series
) -> dict[str, Array]:
    """Beam errors [mrad] of each heliostat's judges."""
    return {
        name: 1e3 * pointing_error(plant.heliostats[name], mounts[name], own)
        for name, own in judged.items()
        if own
    }


def covered(plant: Plant, mounts: dict[str, CalibratedMount], judged: Series) -> float:
    """Share of judges within their 90 % ellipse."""
    inside: list[bool] = []
    for name, own in judged.items():
        std = standard_deviations(plant, mounts[name], name, own)
        off = 1e3 * pointing_error(plant.heliostats[name], mounts[name], own)
        inside.extend(off**2 < 4.605 * std**2)
    return float(np.mean(inside))


def median_row(label: str, errors: dict[str, Array], goal: str | None = None) -> str:
    """A row: median of medians with its interval, those of each half, and how many heliostats.

    ``goal`` is that of the median.
    """
    medians = {name: float(np.median(error)) for name, error in errors.items()}
    apart = [value for name, value in medians.items() if name not in DEVELOPED_ON]
    values = np.array(list(medians.values()))
    low, high = bootstrap(
        (values,), np.median, n_resamples=4000, confidence_level=0.9, method="percentile", rng=0
    ).confidence_interval
    log_row(
        "Beam errors of measurements left out",
        label,
        {
            "median [mrad]": Estimate(np.median(values), (low, high), 90, goal),
            "heliostats not developed on [mrad]": np.median(apart),
        },
        n=len(values),
        of="heliostats",
        compared_with="measured spots",
    )
    return (
        f"| {label} | {np.median(values):.2f} ({low:.2f} to {high:.2f}) | {np.median(apart):.2f} |"
        f" {len(values)} |"
    )


def accuracy(plant: Plant) -> None:
    """Beam errors of measurements left out."""
    print(
        "| left out | median [mrad] (90 % of heliostats drawn) | heliostats not developed on |"
        " heliostats |"
    )
    print("| --- | --- | --- | --- |")
    many = {name: own for name, own in plant.readings.items() if len(own) >= LEAST}
    plant.calibrate(plant.readings)
    nominal = dict.fromkeys(many, CalibratedMount.uncalibrated())
    # One property file has drives that could not stand where its motors were.
    kind = {name: own for name, own in many.items() if name not in plant.unusual}
    print(median_row("nothing: PAINT's kinematics, uncorrected", errors_mrad(plant, nominal, kind)))
    rules: dict[str, Callable[[Sequence[Reading], np.random.Generator], NDArray[np.intp]]] = {
        "a random third": random_third,
        "the last third in time": last_third,
        "the third of suns farthest from all others": far_third,
    }
    shares = {}
    for label, rule in rules.items():
        generator = np.random.default_rng(0)
        parts = {name: split(own, rule(own, generator)) for name, own in many.items()}
        few = {name: own for name, own in plant.readings.items() if name not in many}
        mounts, _ = plant.calibrate({name: kept for name, (kept, _) in parts.items()} | few)
        judged = {name: apart for name, (_, apart) in parts.items()}
        print(median_row(label, errors_mrad(plant, mounts, judged), GOALS[label]))
        shares[label] = covered(plant, mounts, judged)
    print(
        median_row(
            f"the last third, each of {PARTS} parts by all before it", as_it_comes(plant, many)
        )
    )
    print(
        median_row("all but five in a row, prior of the others", five_only(plant, many), "<= 2.5")
    )
    print()
    for label, share in shares.items():
        print(f"within their 90 % interval, {label}: {100 * share:.0f} %")
        cells = {"within their 90 % intervals [%]": 100 * share}
        log_row("Intervals of beam errors", label, cells, n=len(many), of="heliostats")


def as_it_comes(plant: Plant, many: Series) -> dict[str, Array]:
    """Errors of the newest third by mounts that are calibrated again before each of its parts."""
    found: dict[str, list[Array]] = {name: [] for name in many}
    for part in range(PARTS):
        known, judged = dict(plant.readings), {}
        for name, own in many.items():
            first, last = (
                len(own) - len(own) // 3 + place * (len(own) // 3) // PARTS
                for place in (part, part + 1)
            )
            known[name], judged[name] = own[:first], own[first:last]
        mounts, _ = plant.calibrate(known)
        for name, errors in errors_mrad(plant, mounts, judged).items():
            found[name].append(errors)
    return {name: np.concatenate(errors) for name, errors in found.items()}


def five_only(plant: Plant, many: Series) -> dict[str, Array]:
    """Errors of the next thirty measurements after five, at three times, with a prior that others
    made.
    """
    errors = {}
    for name, own in many.items():
        _, field = plant.calibrate(
            {other: series for other, series in plant.readings.items() if other != name}
        )
        found = []
        for begin in np.linspace(0, len(own) - 15, 3).astype(int):
            mounts, _ = plant.calibrate({name: own[begin : begin + 5]}, field)
            found.append(errors_mrad(plant, mounts, {name: own[begin + 5 : begin + 35]})[name])
        errors[name] = np.concatenate(found)
    return errors


def forward(plant: Plant) -> None:
    """Predicted intervals of pointing errors, by measurements that follow those of calibrations."""
    print("| kept | all | not moved | not moved, within 5 days | moved | measurements |")
    print("| --- | --- | --- | --- | --- | --- |")
    for kept in FORWARD_KEPT:
        inside, moved, apart = list[Flags](), list[Flags](), list[Array]()
        for place in np.linspace(0, 1, FORWARD_PLACES):
            known, judged = {}, {}
            for name, own in plant.readings.items():
                begin = round(place * (len(own) - kept - FORWARD_JUDGES))
                is_long = len(own) >= max(LEAST, kept + FORWARD_JUDGES)
                known[name] = own[begin : begin + kept] if is_long else own
                if is_long:
                    judged[name] = own[begin + kept : begin + kept + FORWARD_JUDGES]
            mounts, _ = plant.calibrate(known)
            for name, errors in errors_mrad(plant, mounts, judged).items():
                mount, own = mounts[name], judged[name]
                if mount.prediction is None:
                    continue
                low, high = 1e3 * mount.prediction.low, 1e3 * mount.prediction.high
                inside.append((errors >= low) & (errors <= high))
                moved.append(errors > MOVED_STD * standard_deviations(plant, mount, name, own))
                apart.append(np.array([one.day for one in own]) - known[name][-1].day)
        held, has_moved = np.concatenate(inside), np.concatenate(moved)
        days = np.concatenate(apart)
        cells = {
            "all [%]": 100 * held.mean(),
            "not moved [%]": Estimate(100 * held[~has_moved].mean(), goal=">= 85"),
            "not moved, within 5 days [%]": 100 * held[~has_moved & (days < 5)].mean(),
            "moved [%]": 100 * has_moved.mean(),
        }
        values = [f"{getattr(one, 'value', one):.0f}" for one in cells.values()]
        print(f"| {kept} | {' | '.join(values)} | {len(held)} |")
        log_row(
            "Later spots in the predicted intervals of pointing errors",
            f"{kept} measurements kept",
            cells,
            n=len(held),
            of="measurements",
            compared_with="measured spots",
        )


def standard_deviations(
    plant: Plant, mount: CalibratedMount, name: str, own: Sequence[Reading]
) -> Array:
    """Standard deviations [mrad] of a mount's forecasts, per direction."""
    motors, suns, spots = (
        np.array([getattr(one, key) for one in own]) for key in ("motors", "sun", "spot")
    )
    days = np.array([one.day for one in own])
    cov = spot_covariance(mount, plant.heliostats[name], motors, suns, spots, days)
    return 1e3 * np.sqrt(np.trace(cov, axis1=1, axis2=2) / 2)


def with_step(
    heliostat: Heliostat,
    mount: CalibratedMount,
    own: Sequence[Reading],
    place: int,
    axis: int,
    size: float,
) -> list[Reading]:
    """A series whose drive has an angle ``size`` [rad] more than its motor says, from a measurement
    on.
    """
    zeros = np.zeros(2)
    zeros[axis] = size
    drives = mount.mount(heliostat.mount)
    changed = list(own)
    for after in range(place, len(own)):
        motors = drives.motors_from_angles(drives.angles_from_motors(own[after].motors) - zeros)
        changed[after] = Reading(
            own[after].name,
            own[after].target,
            motors,
            own[after].sun,
            own[after].spot,
            own[after].day,
        )
    return changed


def steps(plant: Plant) -> None:
    """Steps put into real series: found within one measurement, and others found that were not
    there before.
    """
    generator = np.random.default_rng(1)
    many = {name: own for name, own in plant.readings.items() if len(own) >= LEAST}
    _, field = plant.calibrate(plant.readings)
    before = {name: plant.calibrate({name: own}, field)[0][name] for name, own in many.items()}
    real = sum(len(mount.steps) for mount in before.values())
    moved = [name for name, mount in before.items() if mount.steps]
    print(
        f"steps in the series as they are: {real} in {_years(many.values()):.1f} heliostat-years,"
        f" all of {moved}"
    )
    cells = {"steps": real, "heliostat-years": _years(many.values()), "of": ", ".join(moved)}
    log_row("Steps in real series", "as they are", cells, n=len(many), of="heliostats")
    print(
        "| step [mrad] | found within one measurement | others that came with it, a"
        " heliostat-year |"
    )
    print("| --- | --- | --- |")
    for size in STEPS_MRAD:
        found, others, looked = 0, 0, 0.0
        for _ in range(TRIALS):
            name = str(generator.choice(list(many)))
            own, mount = many[name], before[name]
            probable = [
                place
                for place in range(3, len(own) - 3)
                if not mount.foreign[place - 1 : place + 2].any()
            ]
            place, axis = int(generator.choice(probable)), int(generator.integers(2))
            angle = 1e-3 * size * generator.choice([-1.0, 1.0])
            changed = with_step(plant.heliostats[name], mount, own, place, axis, angle)
            places = [step.after for step in plant.calibrate({name: changed}, field)[0][name].steps]
            found += any(abs(step - place) <= 1 for step in places)
            known = [place, *(step.after for step in mount.steps)]
            others += sum(min(abs(step - other) for other in known) > 1 for step in places)
            looked += _years([own])
        print(f"| {size:g} | {100 * found / TRIALS:.0f} % | {others / looked:.2f} |")
        log_row(
            "Steps put into real series",
            f"{size:g} mrad",
            {
                "found within one measurement [%]": proportion(found, TRIALS),
                "others, a heliostat-year": others / looked,
            },
            n=TRIALS,
            of="trials",
            compared_with="the steps put in",
        )


def clocks(plant: Plant) -> None:
    """A clock that goes a minute wrong from a measurement of real series on."""
    generator = np.random.default_rng(3)
    days = np.sort([one.day for own in plant.readings.values() for one in own])
    found = calibrate_field(plant.heliostats, plant.readings, plant.targets, plant.site).clock
    print(f"fault of the clock in the series as they are: {found}")
    errors, late = [], []
    for trial in range(CLOCK_TRIALS):
        since, minutes = generator.choice(days[len(days) // 10 : -len(days) // 10]), (-1.0) ** trial
        changed = with_clock(plant.readings, float(since), minutes, plant.site)
        done = calibrate_field(plant.heliostats, changed, plant.targets, plant.site)
        if done.clock is not None:
            errors.append(done.clock.minutes + minutes)
            late.append(done.clock.since - np.floor(since))
    said = (
        f"off by {np.sqrt(np.mean(np.square(errors))):.2f} minutes (root mean square)"
        if errors
        else ""
    )
    dated = sum(apart == 0 for apart in late)
    log_row(
        "A clock that goes a minute wrong",
        "put into real series",
        {
            "found": len(errors),
            "on its day": dated,
            "off by, root mean square [minutes]": np.sqrt(np.mean(np.square(errors or [np.nan]))),
        },
        n=CLOCK_TRIALS,
        of="trials",
        compared_with="the faults put in",
    )
    log_row(
        "A clock that goes a minute wrong", "series as they are", {"found": int(found is not None)}
    )
    print(
        f"a minute, at {CLOCK_TRIALS} times: {len(errors)} found, {dated} of them on its day,"
        f" {said}"
    )


def covariates(plant: Plant) -> None:
    """What time of day, season and weather explain of errors of measurements left out."""
    done = calibrate_field(plant.heliostats, plant.readings, plant.targets, plant.site)
    print("| covariate | measurements | sidewards, share of squared errors (95 %) | upwards |")
    print("| --- | --- | --- | --- |")
    for name, one in done.covariates.items():
        shares = [
            f"{100 * share:.1f} % ({100 * one.ci95[way][0]:.1f} to {100 * one.ci95[way][1]:.1f})"
            for way, share in one.share.items()
        ]
        cells = {
            f"{way}, share of squared errors [%]": Estimate(
                100 * share, (100 * one.ci95[way][0], 100 * one.ci95[way][1])
            )
            for way, share in one.share.items()
        }
        log_row(
            "Covariates of errors of measurements left out",
            name,
            cells or {"measurements": "not stored"},
            n=one.measurements,
            of="measurements",
        )
        print(
            f"| {name} | {one.measurements} |"
            f" {' | '.join(shares or ['not stored', 'not stored'])} |"
        )


def with_clock(readings: Series, since: float, minutes: float, site: Site) -> Series:
    """Series whose suns are computed by a clock that goes so many minutes fast from a day on."""
    return {
        name: [
            replace(one, sun=site.advance_sun(one.sun, minutes)) if one.day >= since else one
            for one in own
        ]
        for name, own in readings.items()
    }


def _years(series: Iterable[Sequence[Reading]]) -> float:
    return sum((own[-1].day - own[0].day) / 365.25 for own in series)


def synthetic(
    plant: Plant, heliostats: int, measurements: int
) -> tuple[dict[str, Heliostat], Series]:
    """A field of copies of real heliostats, with a part of each one's measurements."""
    generator = np.random.default_rng(2)
    names = [name for name, own in plant.readings.items() if len(own) >= measurements]
    copies: dict[str, Heliostat] = {}
    series: Series = {}
    for number in range(heliostats):
        name = names[number % len(names)]
        chosen = sorted(generator.permutation(len(plant.readings[name]))[:measurements])
        copies[f"H{number:04d}"] = plant.heliostats[name]
        series[f"H{number:04d}"] = [plant.readings[name][place] for place in chosen]
    return copies, series


def spots(plant: Plant) -> None:
    """AA39's mounts by the spots that its photographs show, and by those that PAINT gives."""
    folder = read_folder(data_folder().parent / "stj-years")
    others = {name: own for name, own in plant.readings.items() if name != "AA39"}
    mirror, prior = folder.plant.heliostats["AA39"], plant.calibrate(others)[1]
    shown = {one.name: one for one in read_readings(folder)["AA39"]}
    given = {one.name: one for one in read_readings(folder, kinds=())["AA39"]}
    uncut = {name: one for name, one in given.items() if name in shown}
    print(f"{len(given)} spots given, {len(given) - len(uncut)} of them cut by the target's edge")
    print("| calibrated by | judged by | a random third | the last third | the far suns |")
    print("| --- | --- | --- | --- | --- |")
    for label, judge, fitted, judges in (
        ("shown", "shown", shown, shown),
        ("given", "given", given, uncut),
        ("given, without the cut", "given", uncut, uncut),
        ("shown", "given", shown, uncut),
        ("given", "shown", given, shown),
    ):
        medians = []
        for rule, draws in ((random_third, 8), (last_third, 1), (far_third, 1)):
            found = []
            for draw in range(draws):
                own = sorted(uncut.values(), key=lambda one: np.nan_to_num(one.day))
                apart = {own[place].name for place in rule(own, np.random.default_rng(draw))}
                kept = [one for name, one in fitted.items() if name not in apart]
                done = calibrate_field(
                    {"AA39": mirror}, {"AA39": kept}, plant.targets, plant.site, prior=prior
                )
                held_out = [judges[name] for name in sorted(apart)]
                found.append(1e3 * pointing_error(mirror, done.mounts["AA39"], held_out))
            medians.append(float(np.median(np.concatenate(found))))
        print(f"| {label} | {judge} | {' | '.join(f'{one:.2f}' for one in medians)} |")
        columns = ("a random third [mrad]", "the last third [mrad]", "the far suns [mrad]")
        log_row(
            "AA39's mounts by spots shown in photographs and by spots that PAINT gives",
            f"by {label}, judged by {judge}",
            dict(zip(columns, medians, strict=True)),
            n=len(fitted),
            of="spots",
            compared_with="spots left out",
        )


def speed(plant: Plant, heliostats: int = 2000, measurements: int = 60) -> None:
    """Time of a calibration of a large field."""
    copies, series = synthetic(plant, heliostats, measurements)
    began = time.perf_counter(), time.process_time()
    done = calibrate_field(copies, series, plant.targets, plant.site)
    wall, busy = time.perf_counter() - began[0], time.process_time() - began[1]
    found = sum(len(mount.steps) for mount in done.mounts.values())
    print(
        f"{heliostats} heliostats x {measurements} measurements: {wall:.1f} s, {busy:.1f} s of a"
        f" core, {found} steps"
    )
    log_row(
        "Calibration of a large field",
        f"{heliostats} heliostats with {measurements} measurements each",
        {"processor [s]": Estimate(busy, goal="<= 60"), "steps found": found},
    )


def left_out(plant: Plant) -> dict[str, Array]:
    """Beam errors [mrad] of all measurements, each by mounts that a third of them, and it, had no
    part in.
    """
    errors = {name: np.zeros(len(own)) for name, own in plant.readings.items()}
    order = {
        name: np.random.default_rng(0).permutation(len(own)) for name, own in plant.readings.items()
    }
    for fold in range(3):
        parts = {name: split(own, order[name][fold::3]) for name, own in plant.readings.items()}
        mounts, _ = plant.calibrate({name: kept for name, (kept, _) in parts.items()})
        for name, found in errors_mrad(
            plant, mounts, {name: apart for name, (_, apart) in parts.items()}
        ).items():
            errors[name][np.sort(order[name][fold::3])] = found
    return errors


def picture(plant: Plant, path: Path) -> None:
    """Errors by the sun, before and after, and the drives over time with their steps."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    names = [name for name in ("BE36", "BF57", "BG16", "AA39") if name in plant.readings]
    mounts, _ = plant.calibrate(plant.readings)
    after, uncorrected = left_out(plant), CalibratedMount.uncalibrated()
    figure, axes = plt.subplots(
        len(names), 3, figsize=(15, 3 * len(names)), squeeze=False, layout="constrained"
    )
    for row, name in zip(axes, names, strict=True):
        own, mount = plant.readings[name], mounts[name]
        azimuth, elevation = sun_angles(np.array([one.sun for one in own]))
        before = 1e3 * pointing_error(plant.heliostats[name], uncorrected, own)
        for panel, label, off in zip(
            row, ("uncorrected", "left out of calibration"), (before, after[name]), strict=False
        ):
            shown = panel.scatter(
                azimuth, elevation, c=np.log10(off + 1e-3), vmin=-1, vmax=2, s=12, cmap="viridis"
            )
            panel.set(
                title=f"{name}, {label}",
                xlabel="sun azimuth from north [deg]",
                ylabel="elevation [deg]",
            )
            bar = figure.colorbar(shown, ax=panel, ticks=[-1, 0, 1, 2])
            bar.ax.set_yticklabels(["0.1", "1", "10", "100 mrad"])
        days, known = mount.days - mount.days[0], ~mount.foreign
        zeros = 1e3 * (mount.drift + mount.jitter + mount.stepped - mount.stepped[-1])
        for axis, label in enumerate(("first drive", "second drive")):
            row[2].plot(days[known], zeros[known, axis], ".", label=label)
        for step in mount.steps:
            row[2].axvline((days[step.before] + days[step.after]) / 2, color="0.7", linewidth=1)
        ticks = [-100, -10, -1, 0, 1, 10, 100]
        row[2].set_yscale("symlog", linthresh=2)
        row[2].set_yticks(ticks, [f"{tick}" for tick in ticks])
        row[2].set(
            title=f"{name}: zeros of its drives, steps grey",
            xlabel="days",
            ylabel="mrad",
            ylim=(-200, 200),
        )
        row[2].legend(fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=70)
    print(f"{path} drawn")


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    default = [data_folder().parent / name for name in ("stj-pointing", "stj-years")]
    parser.add_argument("--data", type=Path, nargs="+", default=default)
    parser.add_argument(
        "--only",
        choices=(
            "accuracy",
            "forward",
            "steps",
            "clock",
            "covariates",
            "spots",
            "speed",
            "picture",
        ),
        nargs="*",
    )
    parser.add_argument("--out", type=Path, default=Path("results/pointing.png"))
    options = parser.parse_args()
    plant = Plant(options.data)
    parts: dict[str, Callable[[], None]] = {
        "accuracy": lambda: accuracy(plant),
        "forward": lambda: forward(plant),
        "steps": lambda: steps(plant),
        "clock": lambda: clocks(plant),
        "covariates": lambda: covariates(plant),
        "spots": lambda: spots(plant),
        "speed": lambda: speed(plant),
        "picture": lambda: picture(plant, options.out),
    }
    for name, part in parts.items():
        if not options.only or name in options.only:
            with recording(f"pointing-{name}"):
                part()
            print()


if __name__ == "__main__":
    main()
