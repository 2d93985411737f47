"""The closed loop on two years of photographs, by date: ``python -m benchmarks.years [--out
REPORT.json]``.

AA39 in ``../shared/stj-years`` and, with AC43, in ``../shared/stj``, with the surfaces that
deflectometry measured. The days are dealt out to two halves. A study sees one half only: it chooses
effects, fits them, and the photographs of the other half's days, which had no say in anything,
judge them; then the halves change places. Intervals are over days: photographs of a day err
together. What comes by day cannot be carried to other days: it is judged by photographs of the same
days, as the study itself does it, and its usual value by the others.

What each of the best effects gives alone, and all of them jointly, is fitted to each half and
judged by the other; only which these are was chosen by all photographs.

With ``--moved DATE`` instead what has moved spots since a calibration by the photographs before
that day.
"""

import argparse
import json
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import bootstrap

from benchmarks import data_folder
from benchmarks.folders import read_photographs
from benchmarks.record import Estimate, log_row, recording
from heliotwin.folder_pointing import calibrate_folder
from model.effects import CATALOGUE, Effect, effect_to_json, effects_from_json
from model.metrics import flux_accuracies
from model.plant_model import JUELICH_MODEL
from model.study import FluxImage, Study, StudyOptions, conclude, study, study_to_json
from model.study.fitting import Fitter
from model.study.flux_images import Forecaster
from model.study.parameters import ParameterVector, Term
from service.sources.folder import read_folder

Array = NDArray[np.float64]

WINDOW = 4.0

FEW = 4
"""How many of the best effects are fitted alone and jointly."""


def photographs() -> list[FluxImage]:
    """Those of both folders, each once: as a crop where there is one."""
    root = data_folder()
    crops, _ = read_photographs(read_folder(root.parent / "stj-years"))
    known = {p.key for p in crops}
    others, _ = read_photographs(read_folder(root, ["AA39", "AC43"]))
    return [*crops, *(p for p in others if p.key not in known)]


def day_of(photograph: FluxImage) -> str:
    """The day of a photograph; those of no known time have one for each."""
    return photograph.key if photograph.taken_at is None else photograph.taken_at.date().isoformat()


def accuracies(taken: Sequence[FluxImage], effects: Sequence[Effect]) -> Array:
    """Of photographs (N,) in a window of 4 m."""
    judge = Forecaster(taken, JUELICH_MODEL, WINDOW, StudyOptions().view)
    return flux_accuracies(judge.measured(), judge.cuts(effects))


def interval(values: Array, days: Sequence[str], rounds: int = 2000) -> tuple[float, float]:
    """The 95 % interval of the mean of ``values`` (N,), with days resampled."""
    _, place = np.unique(days, return_inverse=True)
    sums, counts = np.bincount(place, values), np.bincount(place)

    def mean(sums: Array, counts: Array, axis: int) -> Array:
        return np.asarray(sums.sum(axis=axis) / counts.sum(axis=axis))

    drawn = bootstrap(
        (sums, counts), mean, paired=True, n_resamples=rounds, method="percentile", rng=0
    )
    return float(drawn.confidence_interval.low), float(drawn.confidence_interval.high)


def halves(taken: Sequence[FluxImage]) -> list[list[FluxImage]]:
    """Every second day in each."""
    days = sorted({day_of(p) for p in taken})
    return [[p for p in taken if days.index(day_of(p)) % 2 == half] for half in (0, 1)]


def fitted(taken: Sequence[FluxImage], names: Sequence[str]) -> list[Effect]:
    """Effects that are always there, fitted to photographs together."""
    views = StudyOptions().fit_view, StudyOptions().view
    coarse, fine = (Forecaster(taken, JUELICH_MODEL, WINDOW, view) for view in views)
    facets = tuple(sorted({(p.heliostat, len(p.setup.control_points)) for p in taken}))
    unknowns = ParameterVector(tuple(Term(CATALOGUE[name]) for name in names), facets)
    return unknowns.effects(Fitter(coarse, fine).fit(unknowns, unknowns.neutral).values)


def gains(both: Sequence[Sequence[FluxImage]], label: str, names: Sequence[str]) -> str:
    """What effects give together on the days that they were not fitted to, over both halves."""
    changes = [
        accuracies(unseen, fitted(seen, names)) - accuracies(unseen, [])
        for seen, unseen in (tuple(both), tuple(reversed(both)))
    ]
    gain = np.concatenate(changes)
    low, high = interval(gain, [day_of(p) for half in reversed(both) for p in half])
    log_row(
        "The best effects, fitted to half of the days and judged by the others",
        label,
        {"gain in accuracy": Estimate(gain.mean(), (low, high))},
        n=len(gain),
        of="photographs",
        compared_with="forecasts without effects, intervals over days",
    )
    return f"{gain.mean():+.4f} [{low:+.4f}, {high:+.4f}]"


def described(found: Study) -> str:
    """The effects of a study in one line."""
    names = [
        f"{f.described} ({f.gain.mean:.3f} [{f.gain.low:.3f}, {f.gain.high:.3f}])"
        for f in found.found
    ]
    return "; ".join(names) or "none"


MOVING = ("axis_tilt", "sun_position", "pylon_bending", "encoder_offset")


def moved(until: datetime) -> None:
    """Print what has moved AA39's spots since a mount was calibrated by its photographs before a
    day.
    """
    folder = read_folder(data_folder().parent / "stj-years")
    with TemporaryDirectory() as root:
        report = calibrate_folder(folder, Path(root) / "mounts.json", until=until)
        taken, _ = read_photographs(folder, Path(root) / "mounts.json")
    newer = [p for p in taken if p.setup.angles is not None]
    deviations = [np.linalg.norm(p.spot_shifts_rad) for p in newer if p.spot_shifts_rad is not None]
    print(
        f"{report['heliostats']['AA39']['measurements']} measurements before {until.date()},"
        f" {len(newer)} newer;"
    )
    print(
        f"their spots: {1e3 * np.median([p.spot_std_rad for p in newer]):.1f} mrad each,", end=" "
    )
    print(
        f"{1e3 * np.median(deviations) / 2**0.5:.1f} mrad in common by what the calibration leaves"
        " open",
        flush=True,
    )
    options = StudyOptions(candidates=MOVING, window=WINDOW)
    found = study(taken, JUELICH_MODEL, options=options)
    print(
        f"{conclude(found)}\nfound: {described(found)}; from motors [mrad]:"
        f" {found.position_error_mrad}"
    )
    cells: dict[str, Any] = {"finds": described(found)}
    if (error := found.position_error_mrad) is not None:
        cells |= {"spots without [mrad]": error.before, "spots with [mrad]": error.after}
    log_row(
        "What moved AA39's spots since a calibration",
        str(until.date()),
        cells,
        n=len(newer),
        of="photographs",
    )
    print(f"  {json.dumps([effect_to_json(e) for e in found.effects])[:400]}")
    print("alone: " + ", ".join(f"{c.name} {c.gain.mean:+.4f}" for c in found.candidates))


def main() -> None:
    """Print what the whole says, and what each half of the days finds for the other."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, help="write the report of the whole there")
    parser.add_argument(
        "--moved",
        metavar="DATE",
        help="only what has moved spots since a calibration up to that day",
    )
    options = parser.parse_args()
    if options.moved:
        with recording(f"years-moved-{options.moved}"):
            moved(datetime.fromisoformat(options.moved).replace(tzinfo=UTC))
        return
    with recording("years"):
        of_halves(options.out)
        of_one("AA31")


def study_cells(found: Study, before: Array, after: Array) -> dict[str, Any]:
    """What a study finds, accuracies (N,) without and with its effects, and what has no name."""
    cells: dict[str, Any] = {"finds": described(found)}
    cells |= {"accuracy without": before.mean(), "accuracy with": after.mean()}
    if (unnamed := found.discrepancy) is not None:
        cells["what has no name"] = unnamed.described
        cells["explains [%]"] = 100 * unnamed.explained_share
    return cells


def of_one(name: str) -> None:
    """Print what a study of a mirror with few photographs says; days left out in turn judge it."""
    taken, _ = read_photographs(read_folder(data_folder(), [name]))
    found = study(taken, JUELICH_MODEL, options=StudyOptions(window=WINDOW))
    print(f"{name}: {len(taken)} photographs: {conclude(found)}")
    cells = study_cells(found, found.accuracy_before, found.accuracy_after)
    unnamed = found.discrepancy
    if unnamed is not None and (days := unnamed.transfer["days"]) is not None:
        cells["gain by its correction"] = days.after - days.before
    log_row("Studies", f"{name}, all days", cells, n=len(taken), of="photographs")


def of_halves(out: Path | None) -> None:
    """Print what the whole says, and what each half says of the other."""
    taken, asked = photographs(), StudyOptions(window=WINDOW)
    whole = study(taken, JUELICH_MODEL, options=asked)
    print(f"{len(taken)} photographs on {len({day_of(p) for p in taken})} days: {conclude(whole)}")
    before, after = whole.accuracy_before.mean(), whole.accuracy_after.mean()
    print(f"found: {described(whole)}; without effects {before:.4f}, with {after:.4f}")
    log_row(
        "Studies",
        "all days, judged by held-out photographs",
        study_cells(whole, whole.accuracy_before, whole.accuracy_after),
        n=len(taken),
        of="photographs",
    )
    both, best = halves(taken), [c.name for c in whole.candidates[:FEW]]
    print("| the best effects | gain on the days that they were not fitted to, 95 % over days |")
    print("| --- | --- |")
    for name in best:
        print(f"| {name} alone | {gains(both, f'`{name}` alone', [name])} |", flush=True)
    jointly = f"{' and '.join(best)} jointly"
    print(f"| {jointly} | {gains(both, jointly, best)} |", flush=True)
    if out:
        out.write_text(json.dumps(study_to_json(whole), indent=1), encoding="utf-8")
    print(
        "| a study of | finds | photographs of the other days | before | after | gain, 95 % over"
        " days |"
    )
    print("| --- | --- | --- | --- | --- | --- |")
    even, odd = both
    for name, seen, unseen in (("even days", even, odd), ("odd days", odd, even)):
        found = study(seen, JUELICH_MODEL, options=asked)
        before, after = accuracies(unseen, []), accuracies(unseen, found.effects)
        low, high = interval(after - before, [day_of(p) for p in unseen])
        gain = f"{(after - before).mean():+.4f} [{low:+.4f}, {high:+.4f}]"
        cells = study_cells(found, before, after)
        cells["gain"] = Estimate((after - before).mean(), (low, high))
        if found.discrepancy is not None:
            change = accuracies(unseen, effects_from_json(study_to_json(found))) - before
            held = interval(change, [day_of(p) for p in unseen])
            cells["gain by its correction"] = Estimate(change.mean(), held)
        log_row(
            "Studies", f"{name}, judged by the other days", cells, n=len(unseen), of="photographs"
        )
        print(
            f"| {name} | {described(found)} | {len(unseen)} | {before.mean():.4f} |"
            f" {after.mean():.4f} | {gain} |"
        )
        print(f"  {json.dumps([effect_to_json(e) for e in found.effects])[:400]}", flush=True)


if __name__ == "__main__":
    main()
