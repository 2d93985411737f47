"""What the study finds in a season's photographs, in which effects come and go: ``python -m
benchmarks.scopes``.

Each case of `tests.undeclared.changes` is written as a measurement folder of 8-bit photographs of a
sunlit sheet, with times, and studied as ``heliotwin study`` does. An answer is right if it names
the effect and its scope: the day of a change within one photograph of those concerned, and the
heliostat. Nothing may be found in calm seasons, and no date where a target has had another camera
from the beginning. As in `benchmarks.study`, answers are kept in ``OUT/cases.jsonl``, and a
later call does what is missing; ``OUT/scopes.md`` and ``OUT/scopes.png`` show them all.
"""

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from operator import itemgetter
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure

from benchmarks.record import log_row, proportion, recording
from benchmarks.study import (
    STRENGTHS,
    Case,
    Record,
    by_strength,
    cases,
    code,
    decimal,
    draw,
    mean,
    percent,
    read,
    run,
    upper_bound,
)
from heliotwin.folder_study import study_folder
from service.sources.folder import read_folder
from tests.undeclared.adapter import write_folder
from tests.undeclared.camera import empty_targets
from tests.undeclared.changes import CHANGES
from tests.undeclared.generator import generate_season

ALIKE = {"law_since": ("camera_response", "camera_shoulder")}
"""Cases that the catalogue has only approximately, and the effects that come near."""

MIN_CHANGE = 1e-3
"""Change of a forecast from which on a photograph counts as one that an effect acts on."""

CALM_SEEDS = 20


def answer(case: Case) -> Record:
    """The study's answer to a case, with the truth and the calendar of the photographs
    beside it.
    """
    torch.set_num_threads(1)
    made = generate_season(case.name, case.level, case.seed)
    with TemporaryDirectory() as root:
        folder = read_folder(write_folder(made, Path(root)))
        start = process_time()
        found = study_folder(folder)
    report = found.to_json()
    true, change = upper_bound(made, found.study)
    moved = change[change > MIN_CHANGE]
    return {
        **asdict(case),
        "code": code(),
        "verdict": report["verdict"],
        "conclusion": report["conclusion"],
        "before": report["before"]["accuracy_mean"],
        "after": report["after"]["accuracy_mean"],
        "true": round(float(true.mean()), 5),
        "change": round(float(moved.mean()), 5) if len(moved) else 0.0,
        "noise": report["noise_floor"],
        "effects": report["effects"],
        "candidates": report["candidates"][:4],
        "truth": made.truth,
        "sheet": "real" if empty_targets() else "drawn",
        "calendar": [[plan.day.isoformat(), plan.heliostat.name] for plan in made.plans],
        "skipped": found.skipped,
        "seconds": round(process_time() - start, 1),
    }


# --- right or wrong
# --------------------------------------------------------------------------------------------------


def named(r: Record) -> bool:
    """Whether the first effect is the true one, or none is reported where there is none."""
    if not r["truth"]:
        return r["name"] == "two_cameras" or not r["effects"]
    return bool(r["effects"]) and r["effects"][0]["name"] in ALIKE.get(
        r["name"], (r["truth"][0]["name"],)
    )


def scoped(r: Record) -> bool:
    """Whether the first effect's kind of scope is the true one; without an effect, that no date is
    made up.
    """
    if not r["truth"]:
        return all(effect["scope"]["kind"] != "since" for effect in r["effects"])
    return bool(r["effects"]) and r["effects"][0]["scope"]["kind"] == r["truth"][0]["scope"]["kind"]


def whose(r: Record) -> bool:
    """Whether it is said to be of the right heliostats."""
    return scoped(r) and (
        not r["truth"]
        or _scope(r["truth"]).get("heliostats") == _scope(r["effects"]).get("heliostats")
    )


def dated(r: Record) -> bool:
    """Whether the change is found within one photograph of the heliostats that it concerns."""
    if not scoped(r) or not r["truth"] or _scope(r["truth"])["kind"] != "since":
        return scoped(r)
    concerned = _scope(r["truth"])["heliostats"]
    days = [day for day, name in r["calendar"] if concerned is None or name in concerned]
    begins = [
        np.searchsorted(days, _scope(effects)["since"]) for effects in (r["truth"], r["effects"])
    ]
    return bool(abs(begins[0] - begins[1]) <= 1)


def right(r: Record) -> bool:
    """Whether all of it is."""
    return named(r) and whose(r) and dated(r)


def _scope(effects: Sequence[Record]) -> dict[str, Any]:
    scope: dict[str, Any] = effects[0]["scope"]
    return scope


# --- what comes of it
# -------------------------------------------------------------------------------------------------


def line(r: Record) -> str:
    """A record in one line."""
    case = f"{r['name']}, {STRENGTHS[r['level']]}, seed {r['seed']}"
    truth = said(r["truth"]) if r["truth"] else "nothing"
    accuracy = f"{r['before']:.3f} -> {r['after']:.3f}, {r['seconds']:.0f} s"
    return (
        f"{'right' if right(r) else 'WRONG'} {case}: {r['verdict']} {said(r['effects'])}; truth"
        f" {truth}; {accuracy}"
    )


def said(effects: Sequence[Record]) -> str:
    """Effects with their scopes."""
    parts = []
    for effect in effects:
        scope = effect["scope"]
        of = f" of {'+'.join(scope['heliostats'])}" if scope.get("heliostats") else ""
        parts.append(f"{effect['name']}{of} {scope['kind']} {scope.get('since', '')}".strip())
    return ", ".join(parts)


def table(records: Sequence[Record]) -> Iterator[str]:
    """A row for each case, its figures by strength."""
    yield (
        "| case | sets | forecast changes where it acts, % | effect, % | kind of scope, % |"
        " heliostat, % | date, % | all of it, % | before | after | truth |"
    )
    yield "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |"
    for name in CHANGES:
        own = [r for r in records if r["name"] == name]
        if own:
            # What the catalogue has only approximately has no truth to forecast with.
            known = bool(own[0]["truth"]) and name not in ALIKE
            change = by_strength(own, lambda r: r["change"], decimal) if known else ""
            shares = " | ".join(
                by_strength(own, rule, percent) for rule in (named, scoped, whose, dated, right)
            )
            accuracy = " | ".join(
                by_strength(own, itemgetter(key), mean) for key in ("before", "after")
            )
            true = by_strength(own, lambda r: r["true"], mean) if known or name == "calm" else ""
            columns = ("effect", "kind of scope", "heliostat", "date", "all of it")
            cells = {f"{c} [%]": s for c, s in zip(columns, shares.split(" | "), strict=True)}
            log_row(
                "Seasons, each answered rightly in",
                f"`{name}`",
                {"forecast changes where it acts [%]": change or None}
                | cells
                | dict(
                    zip(("accuracy without", "accuracy with"), accuracy.split(" | "), strict=True)
                )
                | {"with the truth": true or None},
                n=len(own),
                of="sets",
                compared_with="the known effects",
            )
            yield f"| `{name}` | {len(own)} | {change} | {shares} | {accuracy} | {true} |"


def summary(records: Sequence[Record]) -> Iterator[str]:
    """The figures that the study is measured by."""
    changed = [r for r in records if r["truth"] and _scope(r["truth"])["kind"] != "set"]
    log_right("effects that come and go", changed, ">= 90")
    yield (
        f"Effects that come and go: {len(changed)} sets, all right in"
        f" {percent([right(r) for r in changed])} %,"
    )
    yield f"by strength {by_strength(changed, right, percent) if changed else '-'} %."
    always = [r for r in records if r["truth"] and _scope(r["truth"])["kind"] == "set"]
    for what, named in (("Effects of the whole set", False), ("Effects of one heliostat", True)):
        some = [r for r in always if ("heliostats" in _scope(r["truth"])) == named]
        yield f"{what}: {len(some)} sets, right in {percent([right(r) for r in some])} %."
        log_right(what[0].lower() + what[1:], some)
    calm = [r for r in records if r["name"] == "calm"]
    quiet = [r["verdict"] == "none" for r in calm]
    log_right("calm seasons: nothing found", calm)
    yield (
        f"Calm seasons: {len(calm)}, false alarms {percent([not right(r) for r in calm])} %, none"
        f" {percent(quiet)} %."
    )
    if records:
        sheets = sorted({r.get("sheet", "drawn") for r in records})
        yield (
            f"Sheets of photographs: {' and '.join(sheets)} (real where ../shared/stj/empty-targets"
            " is there)."
        )
        yield f"A study takes {np.median([r['seconds'] for r in records]):.0f} s of one core."


def log_right(row: str, some: Sequence[Record], goal: str | None = None) -> None:
    """Record how many sets are right in effect, scope, heliostat and date."""
    if some:
        count = sum(map(right, some))
        cells = {"count": count, "share [%]": proportion(count, len(some), goal)}
        truth = "the known effects"
        log_row("Right in all of it", row, cells, n=len(some), of="sets", compared_with=truth)


def column(r: Record) -> str:
    """The first effect with its kind of scope, or the verdict where there is none."""
    if not r["effects"]:
        return str(r["verdict"])
    scope = _scope(r["effects"])
    return (
        f"{r['effects'][0]['name']},"
        f" {'one' if scope['kind'] == 'set' and 'heliostats' in scope else scope['kind']}"
    )


def matrix(records: Sequence[Record]) -> Figure:
    """The confusion matrix of all strengths."""
    rows = [name for name in CHANGES if any(r["name"] == name for r in records)]
    columns = [
        "none",
        "unexplained",
        *sorted({column(r) for r in records} - {"none", "unexplained"}),
    ]
    counts = np.zeros((len(rows), len(columns)))
    for r in records:
        counts[rows.index(r["name"]), columns.index(column(r))] += 1
    figure = Figure(figsize=(3 + 0.5 * len(columns), 3 + 0.4 * len(rows)), layout="constrained")
    axes = figure.subplots()
    draw(axes, rows, columns, counts / counts.sum(axis=1, keepdims=True))
    axes.set(
        title="what comes and goes [%]",
        xlabel="effect and scope found first, or verdict",
        ylabel="undeclared",
    )
    return figure


def main() -> None:
    """Run the cases that are missing and show all."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--cases", default=",".join(CHANGES))
    parser.add_argument("--strengths", default=",".join(STRENGTHS))
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("out/scopes"))
    parser.add_argument("--show", action="store_true", help="only show what is there")
    options = parser.parse_args()
    path, names = options.out / "cases.jsonl", options.cases.split(",")
    levels = [STRENGTHS.index(name) for name in options.strengths.split(",")]
    seeds = range(options.first_seed, options.first_seed + options.seeds)
    if not options.show:
        wanted = list(cases(names, levels, seeds))
        if "calm" in names:
            wanted += cases(
                ["calm"], levels, range(seeds.stop, seeds.stop + CALM_SEEDS - options.seeds)
            )
        run(wanted, path, options.jobs, answer, line)
    records = list(read(path).values())
    states = len({r["code"] for r in records})
    with recording("scopes"):
        text = [*summary(records), "", *table(records)]
    text += [f"Answered by {states} states of the code."] if states > 1 else []
    (options.out / "scopes.md").write_text("\n".join(text) + "\n", encoding="utf-8")
    matrix(records).savefig(options.out / "scopes.png", dpi=80)
    print("\n".join(text))


if __name__ == "__main__":
    main()
