"""What the study finds in sets whose undeclared effects are known: ``python -m
benchmarks.study``.

Every disturbance of `tests.undeclared.world` at three strengths, pairs of them, and clean sets;
each seed is another plant. With ``--calibrate`` each effect of the catalogue is taken out of it in
turn, and its sets are studied without it: the verdict's thresholds are chosen by these. Each case
adds a line of JSON to ``OUT/cases.jsonl``; a later call does what is missing, or was answered by
another state of the code. ``OUT/study.md`` and ``OUT/matrix.png`` show them all. With ``--folders``
the sets of ``../shared/undeclared``, whose effects are not known here, are studied instead; with
``--moving`` worlds whose effects move spots, with and without what encoders said; with ``--cost``
time and memory of one study of 100 images.
"""

import argparse
import json
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import nullcontext
from dataclasses import asdict, dataclass
from functools import lru_cache
from hashlib import sha256
from multiprocessing import get_context
from operator import itemgetter
from pathlib import Path
from resource import RUSAGE_SELF, getrusage
from time import process_time
from typing import Any
from unittest import mock

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from benchmarks import data_folder
from benchmarks.record import Estimate, log_row, proportion, recording
from heliotwin.folder_study import study_folder
from model.effects import CATALOGUE as KINDS
from model.metrics import flux_accuracies
from model.plant_model import JUELICH_MODEL
from model.study import FluxImage, Study, StudyOptions, loop, study, study_to_json
from model.study.flux_images import Forecaster
from service.base.processes import limit_memory, return_memory, returning_memory
from service.sources.folder import read_folder
from tests.undeclared.adapter import effects_of, flux_images
from tests.undeclared.generator import MeasurementSet, generate
from tests.undeclared.world import CATALOGUE, LIVES_IN, MOVING, OUTSIDE, UNSEEN

Record = dict[str, Any]
Array = NDArray[np.float64]

STRENGTHS = ("weak", "middle", "strong")

PAIRS = (
    "sun_shape+soiling",
    "camera_response+background",
    "slope_error+facet_canting",
    "camera_blur+gravity_bending",
    "target_registration+tracking_jitter",
)

SHAPED = tuple(name for name in CATALOGUE if not KINDS[name].only_moves)

NAMELESS = (*OUTSIDE, *UNSEEN)

CASES = ("clean", *SHAPED, *NAMELESS, *PAIRS)

TAKEN_OUT = " taken out"
"""Ends the name of a case that is studied without its effect."""

SHARES_LEFT = (0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5, 0.67)
"""Thresholds that ``--calibrate`` compares."""

QUIET = ("clean", "calm")
"""Those that have no strength."""


@dataclass(frozen=True)
class Case:
    """Disturbances joined by ``+``, or ``clean``; their strength; the plant's seed."""

    name: str
    level: int
    seed: int


# --- one case
# --------------------------------------------------------------------------------------------------


def answer(case: Case) -> Record:
    """The study's answer to a case, with the truth beside it."""
    torch.set_num_threads(1)
    name = case.name.removesuffix(TAKEN_OUT)
    made = generate(name, case.level, case.seed)
    without = {name} if case.name.endswith(TAKEN_OUT) else set()
    names = tuple(one for one in KINDS if one not in without)
    options = StudyOptions(candidates=names)
    start = process_time()
    found = study(flux_images(made), JUELICH_MODEL, options)
    seconds = process_time() - start
    report = study_to_json(found)
    true, change = upper_bound(made, found)
    return {
        **asdict(case),
        "code": code(),
        "verdict": report["verdict"],
        "found": [effect["name"] for effect in report["effects"]],
        "before": report["before"]["accuracy_mean"],
        "after": report["after"]["accuracy_mean"],
        "true": round(float(true.mean()), 5),
        "change": round(float(change.mean()), 5),
        "noise": report["noise_floor"],
        "unexplained": report["unexplained_share"],
        "incomplete": found.has_unexplained_error,
        "contradicted_by": found.contradicted_by,
        "discrepancy": report["discrepancy"],
        "lookalikes": [effect["lookalikes"] for effect in report["effects"]],
        "errors": [error for effect in report["effects"] for error in errors(effect, made.truth)],
        "truth": made.truth,
        "effects": report["effects"],
        "candidates": report["candidates"][:4],
        "seconds": round(seconds, 1),
    }


def upper_bound(made: MeasurementSet, found: Study) -> tuple[Array, Array]:
    """Accuracies (H,) of the held-out images with the true effects, and by how much those change
    the forecast (H,).
    """
    forecaster = Forecaster(found.images, JUELICH_MODEL, found.window, StudyOptions().view)
    with_truth = forecaster.cuts(effects_of(made))
    return flux_accuracies(found.measured, with_truth), 1 - flux_accuracies(
        found.before, with_truth
    )


def errors(effect: Record, truth: Sequence[Record]) -> Iterator[Record]:
    """For each parameter of a true effect that was found: its relative error, and the share within
    the intervals.
    """
    true: Record = next((t["parameters"] for t in truth if t["name"] == effect["name"]), {})
    for parameter in KINDS[effect["name"]].parameters():
        expected = flat(true.get(parameter.name, parameter.neutral))
        size = np.linalg.norm(expected - parameter.neutral)
        if size > 0:
            estimate = effect["parameters"][parameter.name]
            value, interval = flat(estimate["value"]), flat(estimate["ci95"]).reshape(-1, 2)
            if (
                effect["name"] == "facet_canting"
            ):  # the tilt of the whole mirror is nobody's to find
                common = value.reshape(-1, 4).mean(axis=1).repeat(4)
                value, interval = value - common, interval - common[:, None]
            inside = (interval[:, 0] <= expected) & (expected <= interval[:, 1])
            yield {
                "name": f"{effect['name']}.{parameter.name}",
                "relative": round(float(np.linalg.norm(value - expected) / size), 4),
                "inside": round(float(inside.mean()), 3),
            }


def flat(value: Any) -> Array:
    """All numbers of a parameter, heliostats by name."""
    if isinstance(value, dict):
        return np.concatenate([flat(value[name]) for name in sorted(value)])
    return np.asarray(value, dtype=np.float64).ravel()


# --- its cost
# --------------------------------------------------------------------------------------------------


def cost() -> None:
    """Time and memory of a study of 100 images, without and with generic terms."""
    taken = flux_images(generate("second_axis_wobble", 2, 0, heliostats=5, setups=20))
    with ProcessPoolExecutor(1, get_context("spawn"), max_tasks_per_child=1) as pool:
        (first_s, first_mb), (seconds, memory_mb) = (
            pool.submit(cost_of, taken, is_with).result() for is_with in (False, True)
        )
    rows = (
        ("without generic terms", {"time [s]": first_s, "peak memory [MB]": first_mb}),
        (
            "with them",
            {
                "time [s]": seconds,
                "time, ratio to that without": Estimate(seconds / first_s, goal="<= 1.5"),
                "peak memory [MB]": Estimate(memory_mb, goal="<= 1000"),
            },
        ),
    )
    for row, cells in rows:
        print(row, *cells.items())
        log_row("A study of 100 images", row, cells, n=len(taken), of="images")


def cost_of(taken: Sequence[FluxImage], is_with_terms: bool) -> tuple[float, float]:
    """Time [s] of this process for a study, and its largest memory [MB], as in a worker."""
    torch.set_num_threads(1)
    limit_memory()
    nothing = mock.patch.object(loop, "find_discrepancy", return_value=None)
    with nullcontext() if is_with_terms else nothing:
        start = process_time()
        with returning_memory():
            study(taken, JUELICH_MODEL, progress=lambda name: return_memory())
        return process_time() - start, getrusage(RUSAGE_SELF).ru_maxrss / 1024


# --- all cases
# --------------------------------------------------------------------------------------------------


@lru_cache(maxsize=1)
def code() -> str:
    """What names the state of the code that studies and makes the sets."""
    root = Path(__file__).parents[1]
    folders = [root / "model" / "effects", root / "model" / "study", root / "model" / "imaging"]
    folders += [root / "tests" / "undeclared"]
    files = sorted(
        file
        for folder in folders
        for file in folder.glob("*.py")
        if not file.name.startswith("test_")
    )
    return sha256(b"".join(file.read_bytes() for file in files)).hexdigest()[:12]


def cases(names: Sequence[str], levels: Sequence[int], seeds: Sequence[int]) -> Iterator[Case]:
    """Seed by seed, the strongest first, so that a run cut short has seen every effect; quiet ones
    once a seed.
    """
    for seed in seeds:
        for level in sorted(levels, reverse=True):
            yield from (
                Case(name, level, seed)
                for name in names
                if name not in QUIET or level == max(levels)
            )


def read(path: Path) -> dict[Case, Record]:
    """Finished cases, the last answer of each."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    records = map(json.loads, lines)
    return {Case(r["name"], r["level"], r["seed"]): r for r in records}


def run(
    wanted: Sequence[Case],
    path: Path,
    jobs: int,
    answer: Callable[[Case], Record],
    line: Callable[[Record], str],
) -> None:
    """Answer the cases that have none, a line each."""
    path.parent.mkdir(parents=True, exist_ok=True)
    done = read(path)
    left = [case for case in wanted if done.get(case, {}).get("code") != code()]
    with (
        ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool,
        path.open("a", encoding="utf-8") as file,
    ):
        for work in as_completed([pool.submit(answer, case) for case in left]):
            record = work.result()
            file.write(json.dumps(record) + "\n")
            file.flush()
            print(line(record), flush=True)


def line(r: Record) -> str:
    """A record in one line."""
    case = f"{r['name']}, {STRENGTHS[r['level']]}, seed {r['seed']}"
    accuracy = f"{r['before']:.3f} -> {r['after']:.3f} (truth {r['true']:.3f})"
    return (
        f"{case:<44} {r['verdict']:<12} {'+'.join(r['found']):<30} {accuracy} {r['seconds']:.0f} s"
    )


# --- what comes of it
# -------------------------------------------------------------------------------------------------


def column(record: Record) -> str:
    """The verdict, or the first effect where that is the verdict."""
    return record["found"][0] if record["verdict"] == "effect" else record["verdict"]


def is_nameless(record: Record) -> bool:
    """Whether no effect of the catalogue is the truth."""
    return record["name"] in NAMELESS or record["name"].endswith(TAKEN_OUT)


def first(record: Record) -> bool:
    """Whether the verdict is right, and the first effect one of the true ones."""
    if is_nameless(record):
        return column(record) == "unexplained"
    return column(record) in ("none" if record["name"] == "clean" else record["name"]).split("+")


def among(record: Record) -> bool:
    """Whether all true effects are among those found."""
    if record["name"] == "clean" or is_nameless(record):
        return first(record)
    return set(record["name"].split("+")) <= set(record["found"])


def undecided(record: Record) -> bool:
    """Whether the true effect is not the first, but the report lists it as a look-alike of it."""
    alike = record["lookalikes"][0] if record["lookalikes"] else []
    return not first(record) and bool(set(record["name"].split("+")) & set(alike))


def is_clear(record: Record) -> bool:
    """Whether an undeclared disturbance changes the forecast by more than twice the noise.

    What the model cannot state has the excess error of the declared model as its size.
    """
    excess = 1 - record["before"] - record["noise"]
    return max(record["change"], excess if is_nameless(record) else 0.0) > 2 * record["noise"]


def recovered(record: Record) -> float:
    """Share of the missing accuracy that the discrepancy, or else the effects found, recover."""
    found = record["discrepancy"]
    after = record["after"] if found is None else max(record["after"], found["accuracy_after"])
    return float((after - record["before"]) / (1 - record["before"] - record["noise"]))


def percent(values: Sequence[float]) -> str:
    """The mean as a percentage."""
    return f"{100 * np.mean(values):.0f}" if len(values) else "-"


def by_strength(
    records: Sequence[Record], of: Callable[[Record], float], form: Callable[[Sequence[float]], str]
) -> str:
    """A figure at each strength there is, the weakest first."""
    levels = sorted({r["level"] for r in records})
    return " / ".join(form([of(r) for r in records if r["level"] == level]) for level in levels)


def table(records: Sequence[Record]) -> Iterator[str]:
    """A row for each disturbance."""
    yield (
        "| undeclared | sets | forecast changes, % | found first, % | among those found, % | before"
        " | after | truth |"
    )
    yield "| --- | --- | --- | --- | --- | --- | --- | --- |"
    for name in CASES:
        own = [r for r in records if r["name"] == name]
        if own:
            change = (
                ""
                if name == "clean" or name in NAMELESS
                else by_strength(own, lambda r: r["change"], decimal)
            )
            shares = " | ".join(by_strength(own, rule, percent) for rule in (first, among))
            accuracy = " | ".join(
                by_strength(own, itemgetter(key), mean) for key in ("before", "after")
            )
            truth = "" if name in NAMELESS else by_strength(own, lambda r: r["true"], mean)
            cells = dict(
                zip(("found first [%]", "among those found [%]"), shares.split(" | "), strict=True)
            )
            log_row(
                "Sets with undeclared effects, by strength: weak / middle / strong",
                f"`{name}`",
                {"forecast changes [%]": change or None}
                | cells
                | dict(
                    zip(("accuracy without", "accuracy with"), accuracy.split(" | "), strict=True)
                )
                | {"with the truth": truth or None},
                n=len(own),
                of="sets",
                compared_with="the known effects",
            )
            yield f"| `{name}` | {len(own)} | {change} | {shares} | {accuracy} | {truth} |"


def decimal(values: Sequence[float]) -> str:
    """The mean as a percentage with a decimal."""
    return f"{100 * np.mean(values):.1f}"


def mean(values: Sequence[float]) -> str:
    """The mean."""
    return f"{np.mean(values):.3f}"


def parameters(records: Sequence[Record]) -> Iterator[str]:
    """A row for each parameter that was found: median of the relative error, share of the truth
    within intervals.
    """
    yield (
        "| parameter | times found | error relative to the truth, median, % | truth within the 95 %"
        " interval, % |"
    )
    yield "| --- | --- | --- | --- |"
    found = [error for r in records if "+" not in r["name"] for error in r["errors"]]
    for name in dict.fromkeys(error["name"] for error in found):
        own = [error for error in found if error["name"] == name]
        relative = 100 * np.median([error["relative"] for error in own])
        log_row(
            "Parameters that were found",
            f"`{name}`",
            {
                "error relative to the truth, median [%]": relative,
                "truth within the 95 % interval [%]": 100 * np.mean([e["inside"] for e in own]),
            },
            n=len(own),
            of="sets",
            compared_with="the known effects",
        )
        yield (
            f"| `{name}` | {len(own)} | {relative:.1f} |"
            f" {percent([error['inside'] for error in own])} |"
        )


def summary(records: Sequence[Record]) -> Iterator[str]:
    """The figures that the study is measured by."""
    single = [r for r in records if r["name"] in CATALOGUE]
    large = [r for r in single if r["change"] > 2 * r["noise"]]
    clean = [r for r in records if r["name"] == "clean"]
    outside = [r for r in records if r["name"] in NAMELESS]
    pairs = [r for r in records if r["name"] in PAIRS]
    log_summary(large, clean, outside)
    yield f"Noise alone costs {decimal([r['noise'] for r in records])} % of accuracy."
    yield (
        f"Effects that change the forecast by more than twice that: {len(large)} sets; found"
        " first in"
    )
    yield (
        f"{percent([first(r) for r in large])} %, among those found in"
        f" {percent([among(r) for r in large])} %;"
    )
    undecided_share = percent([undecided(r) for r in large])
    yield f"named as a look-alike of the first in {undecided_share} %."
    yield (
        f"Clean sets: {len(clean)}, false alarms"
        f" {percent([r['verdict'] != 'none' for r in clean])} %."
    )
    for title, some in (
        ("Outside the catalogue", outside),
        ("Those that no threshold was chosen on", [r for r in outside if r["name"] in UNSEEN]),
    ):
        if some:
            yield from nameless(title, some)
    if pairs:
        refused = [r["verdict"] != "effect" for r in pairs]
        yield f"Pairs of catalogue effects: {len(pairs)}, refused a name {percent(refused)} %."
    yield f"A study takes {np.median([r['seconds'] for r in records]):.0f} s of one core."


def nameless(title: str, records: Sequence[Record]) -> Iterator[str]:
    """What is said of sets whose truth is outside the catalogue."""
    answers = Counter(r["verdict"] for r in records)
    clear = [r for r in records if is_clear(r)]
    said = [r for r in records if r["discrepancy"] and r["discrepancy"]["lives_in"]]
    right = [r["discrepancy"]["lives_in"] == LIVES_IN[r["name"]] for r in said]
    wrong = proportion(answers["effect"], len(records))
    cells = {
        "missing accuracy recovered, clear ones [%]": percent([recovered(r) for r in clear]),
        "where it lives: said [%]": percent([r in said for r in records]),
        "where it lives: right of those said [%]": percent(right),
    }
    low, high = wrong.interval or (0.0, 100.0)
    yield f"{title}: {len(records)} sets, " + ", ".join(f"{v} {n}" for v, n in answers.items())
    yield f"  wrong names {wrong.value:.0f} % [{low:.0f}, {high:.0f}]"
    yield "  " + ", ".join(f"{name} {value}" for name, value in cells.items())
    log_row(
        "Effects outside the catalogue",
        title,
        {"wrong names [%]": wrong} | cells,
        n=len(records),
        of="sets",
    )


def calibration(records: Sequence[Record]) -> Iterator[str]:
    """Names kept and wrong names at each threshold of the share that effects leave.

    Sets are clear ones of single effects: with the whole catalogue, and without their effect.
    """
    clear = [r for r in records if is_clear(r)]
    true = [r for r in clear if r["name"] in SHAPED and r["name"] in r["found"][:1]]
    outside = [r for r in clear if r["name"].endswith(TAKEN_OUT)]
    yield f"{len(true)} sets with the true effect first, {len(outside)} with it taken out"
    yield "| largest share left | true names kept [%] | wrong names [%] |"
    yield "| --- | --- | --- |"

    def is_named(record: Record, share: float | None) -> bool:
        if share is None:
            return bool(record["verdict"] == "effect")
        leaves_little = record["unexplained"] <= share and not record["contradicted_by"]
        return bool(record["found"]) and leaves_little

    for share in (*SHARES_LEFT, None):
        kept, wrong = ([is_named(r, share) for r in some] for some in (true, outside))
        name = "as studies decide" if share is None else f"{share:.2f}"
        log_row(
            "Thresholds of the verdict, by effects that are taken out of the catalogue",
            name,
            {
                "true names kept [%]": proportion(sum(kept), len(kept)) if kept else None,
                "wrong names [%]": proportion(sum(wrong), len(wrong)) if wrong else None,
            },
        )
        yield f"| {name} | {percent(kept)} | {percent(wrong)} |"


def log_summary(
    large: Sequence[Record], clean: Sequence[Record], outside: Sequence[Record]
) -> None:
    """Record how many sets of each kind are answered rightly."""
    table, truth = "Sets answered rightly", "the known effects"
    rows = {
        "effects that change the forecast by more than twice the noise: found first": (
            large,
            first,
        ),
        "clean sets: nothing found": (clean, first),
        "effects outside of the catalogue: unexplained": (outside, first),
        "effects outside of the catalogue: imitated": (outside, lambda r: r["verdict"] == "effect"),
    }
    for row, (some, rule) in rows.items():
        if some:
            count = sum(bool(rule(r)) for r in some)
            cells = {"count": count, "share [%]": proportion(count, len(some))}
            log_row(table, row, cells, n=len(some), of="sets", compared_with=truth)


def confusion(records: Sequence[Record]) -> tuple[list[str], list[str], Array]:
    """Rows, columns and shares (rows, columns) of the answers."""
    rows = [name for name in CASES if any(r["name"] == name for r in records)]
    columns = ["none", *KINDS, "unexplained"]
    shares = np.zeros((len(rows), len(columns)))
    for r in records:
        shares[rows.index(r["name"]), columns.index(column(r))] += 1
    return rows, columns, shares / shares.sum(axis=1, keepdims=True)


def draw(axes: Axes, rows: Sequence[str], columns: Sequence[str], shares: Array) -> None:
    """A confusion matrix, in percent."""
    axes.imshow(shares, cmap="Blues", vmin=0, vmax=1)
    for (row, place), share in np.ndenumerate(shares):
        if share > 0:
            axes.text(
                place,
                row,
                f"{100 * share:.0f}",
                ha="center",
                va="center",
                color="w" if share > 0.5 else "k",
            )
    axes.set_xticks(range(len(columns)), columns, rotation=60, ha="right")
    axes.set_yticks(range(len(rows)), rows)


def matrix(records: Sequence[Record]) -> Figure:
    """The confusion matrix of all strengths, beside that of the sets with more change than twice
    the noise.
    """
    known = [r for r in records if r["name"] not in CATALOGUE or r["change"] > 2 * r["noise"]]
    figure = Figure(figsize=(18, 9), layout="constrained")
    titles = "all strengths", "effects that change the forecast by more than twice the noise"
    for axes, some, title in zip(figure.subplots(1, 2), (records, known), titles, strict=True):
        draw(axes, *confusion(some))
        axes.set(
            title=f"{title} [%]", xlabel="verdict, or the effect found first", ylabel="undeclared"
        )
    return figure


# --- what moves spots
# -------------------------------------------------------------------------------------------------


def moving(seeds: Sequence[int]) -> None:
    """Print which effects are found if spots are moved, by spot and shape and by shape alone.

    Three heliostats have twelve photographs each. A row's numbers are sets in which an effect was
    found first. In brackets: those in which the report cannot distinguish it from another.
    """
    columns = ("axis_tilt", "sun_position", "pylon_bending", "encoder_offset", "another", "none")
    for by_spot in (True, False):
        title = "by spot and shape" if by_spot else "by shape alone"
        print(f"| {title} | {' | '.join(columns)} | before | after [mrad] |")
        print("| --- " * (len(columns) + 3) + "|")
        for case in ("clean", *MOVING):
            found, before, after = Counter[str](), [], []
            for seed in seeds:
                made = generate(case, len(STRENGTHS) - 1, seed, heliostats=3, setups=12, side=96)
                images = flux_images(made, made.encoders(seed) if by_spot else None)
                report = study_to_json(study(images, JUELICH_MODEL))
                first = (report["effects"] or [{"name": "none", "lookalikes": []}])[0]
                name = first["name"] if first["name"] in columns else "another"
                found.update([name, *(["?" + name] if first["lookalikes"] else [])])
                before.append(report["before"].get("position_error_mrad", np.nan))
                after.append(report["after"].get("position_error_mrad", np.nan))
            counts = [
                f"{found[c] or ''}" + (f" ({found['?' + c]})" if found["?" + c] else "")
                for c in columns
            ]
            print(
                f"| `{case}` | {' | '.join(counts)} | {np.mean(before):.1f} |"
                f" {np.mean(after):.1f} |",
                flush=True,
            )
            log_row(
                f"Effects that move spots, {title}",
                f"`{case}`",
                {
                    "found first": ", ".join(f"{c} {found[c]}" for c in columns if found[c]),
                    "spots without [mrad]": np.mean(before),
                    "spots with [mrad]": np.mean(after),
                },
                n=len(seeds),
                of="sets",
                compared_with="the known effects",
            )
        print()


# --- sets whose effects are not known
# ---------------------------------------------------------------------------------


def folders(root: Path) -> None:
    """Print what the study says of each set of a folder."""
    for folder in sorted(root.glob("set-*")):
        report = study_to_json(study_folder(read_folder(folder)).study)
        before, after = (report[when]["accuracy_mean"] for when in ("before", "after"))
        found = ", ".join(f"`{effect['name']}`" for effect in report["effects"]) or "none"
        cells = {"verdict": report["verdict"], "effect": found}
        cells |= {"accuracy without": before, "accuracy with": after}
        log_row("Sets whose effects are not known here", folder.name, cells)
        print(
            f"{folder.name}: {report['verdict']}, {before:.3f} -> {after:.3f}, noise"
            f" {report['noise_floor']:.3f}"
        )
        for effect in report["effects"]:
            print(f"  {effect['name']}")
            for name, found in effect["parameters"].items():
                print(f"    {name} = {found['value']}  95 % {found['ci95']}  {found['unit']}")
        print(f"  {report['conclusion']}", flush=True)


def main() -> None:
    """Run the cases that are missing and show all."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument(
        "--effects", default=",".join(CASES), help="names and pairs a+b, with commas between them"
    )
    parser.add_argument("--strengths", default=",".join(STRENGTHS))
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("out/study-proof"))
    parser.add_argument("--show", action="store_true", help="only show what is there")
    parser.add_argument(
        "--folders", action="store_true", help="study the sets of ../shared/undeclared instead"
    )
    parser.add_argument(
        "--calibrate",
        action="store_true",
        help="study single effects with and without them in the catalogue",
    )
    parser.add_argument(
        "--moving",
        action="store_true",
        help="only worlds in which spots are moved, by their motors",
    )
    parser.add_argument("--cost", action="store_true", help="only time and memory of one study")
    options = parser.parse_args()
    if options.moving:
        with recording("study-moving"):
            moving(range(options.first_seed, options.first_seed + options.seeds))
        return
    if options.cost:
        with recording("study-cost"):
            cost()
        return
    if options.folders:
        with recording("study-folders"):
            folders(data_folder().parent / "undeclared")
        return
    if options.calibrate:
        options.effects = ",".join([*SHAPED, *(name + TAKEN_OUT for name in SHAPED)])
    path = options.out / ("calibration.jsonl" if options.calibrate else "cases.jsonl")
    levels = [STRENGTHS.index(name) for name in options.strengths.split(",")]
    seeds = range(options.first_seed, options.first_seed + options.seeds)
    if not options.show:
        run(
            list(cases(options.effects.split(","), levels, seeds)), path, options.jobs, answer, line
        )
    records = list(read(path).values())
    if options.calibrate:
        with recording("study-calibration"):
            print("\n".join(calibration(records)))
        return
    states = len({r["code"] for r in records})
    with recording("study"):
        text = [*summary(records), "", *table(records), "", *parameters(records)]
    text += [f"Answered by {states} states of the code."] if states > 1 else []
    (options.out / "study.md").write_text("\n".join(text) + "\n", encoding="utf-8")
    matrix(records).savefig(options.out / "matrix.png", dpi=60)
    print("\n".join(text))


if __name__ == "__main__":
    main()
