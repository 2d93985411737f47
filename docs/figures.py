"""Measured figures in the documentation: ``python -m docs.figures`` writes RESULTS.md and README.

Benchmarks write their figures to ``results/NAME.json`` (`benchmarks.record`). A page names a
record, and its tables are inserted when the site is built:

    ```{figures} NAME
    ```

A line of text in the block is the title of a table. Then only the named tables are shown.
"""

import json
import math
import operator
import re
import tomllib
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "results"
SITE = "docs/results"
REACHED: dict[str, Callable[[float, float], bool]] = {"<=": operator.le, ">=": operator.ge}
_SIGNS = {"<=": "≤", ">=": "≥"}
_BLOCK = re.compile(r"^```\{(figures|key-figures|comparison)\} ?(\S*)\n((?:.*\n)*?)```$", re.M)
_README = re.compile(r"(?<=<!-- python -m docs\.figures -->\n).*?(?=\n\n)", re.DOTALL)

Entry = dict[str, Any]


@cache
def read(name: str) -> dict[str, Any]:
    """Read a record."""
    record: dict[str, Any] = json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))
    return record


def records() -> list[str]:
    """Names of all records."""
    return sorted(path.stem for path in RESULTS.glob("*.json"))


# --- one figure


def number(value: Any) -> str:
    """A value with three significant digits; counts and text as they are."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}"
    if not isinstance(value, float):
        return str(value).replace("|", "\\|")
    return f"{value:,.{decimals(value)}f}"


def decimals(value: float) -> int:
    """Decimals of a value: three significant digits, or two of a small one."""
    if value == 0:
        return 0
    digits = 3 if abs(value) >= 0.1 else 2
    return max(0, digits - 1 - math.floor(math.log10(abs(value))))


def is_missed(figure: Entry) -> bool:
    """Whether a figure has a goal and does not reach it."""
    if "goal" not in figure:
        return False
    sign, bound = figure["goal"].split()
    return not REACHED[sign](figure["value"], float(bound))


def goal(text: str) -> str:
    """A goal with its sign."""
    sign, bound = text.split()
    return f"{_SIGNS[sign]} {bound}"


def shown(figure: Entry, unit: str = "") -> str:
    """A figure with its unit and interval."""
    text = number(figure["value"]) + (f" ± {number(figure['std'])}" if "std" in figure else "")
    text += f" {unit}" if unit else ""
    if "interval" in figure:
        places = decimals(float(figure["value"]))
        text += f" [{', '.join(f'{end:,.{places}f}' for end in figure['interval'])}]"
    return text


def _cell(figure: Entry | None, unit: str, shared_goal: str | None) -> str:
    """A figure, with its goal unless the column's head has it."""
    if figure is None:
        return ""
    notes = [f"goal {goal(figure['goal'])}"] if "goal" in figure and not shared_goal else []
    notes += ["missed"] if is_missed(figure) else []
    return shown(figure, unit) + (f" ({', '.join(notes)})" if notes else "")


# --- tables of a record


def block(name: str, titles: Sequence[str] = ()) -> str:
    """The tables of a record, or some of them, below a line that says how they were measured."""
    figures = read(name)["figures"]
    every = list(dict.fromkeys(one["table"] for one in figures))
    if missing := set(titles) - set(every):
        raise KeyError(f"results/{name}.json has no table {', '.join(sorted(missing))}")
    parts = [provenance(read(name))]
    for title in titles or every:
        own = [one for one in figures if one["table"] == title]
        parts.append(f"**{title}**{_context(own)}\n\n{table(own)}")
    return "\n\n".join(parts)


def _context(figures: Sequence[Entry]) -> str:
    """What figures of a table are compared with, and the confidence of their intervals."""
    references = {one["compared_with"] for one in figures if "compared_with" in one}
    levels = {one["level"] for one in figures if "level" in one}
    notes = [f"compared with {', '.join(sorted(references))}"] if references else []
    notes += [f"intervals of {', '.join(map(str, sorted(levels)))} %"] if levels else []
    return f" ({'; '.join(notes)})" if notes else ""


def provenance(record: dict[str, Any]) -> str:
    """How a record was measured."""
    if "source" in record:
        return f"Source: {record['source']}."
    return f"`{record['command']}`: {place(record)}."


def place(record: dict[str, Any]) -> str:
    """Date, commit and machine of a run."""
    made = record["machine"]
    parts = [record["date"], f"commit {record['commit']}"]
    parts += [f"{made['cores']} cores", made["processor"]]
    parts += [f"load {made['load']}"] if "load" in made else []
    return ", ".join(parts)


def table(figures: Sequence[Entry]) -> str:
    """A table with a row for each `row` and a column for each `name`.

    A unit or a number of cases is in the head, if all figures of a column share it, else in the
    row. A goal is in the head or in the cell.
    """
    rows, names = (list(dict.fromkeys(one[key] for one in figures)) for key in ("row", "name"))
    cells = {(one["row"], one["name"]): one for one in figures}
    units = {key: _shared(figures, key, "unit") for key in ("row", "name")}
    counts = {key: _shared(figures, key, "n") for key in ("row", "name")}
    unit_in = next((key for key in ("name", "row") if None not in units[key].values()), None)
    count_in = next((key for key in ("row", "name") if None not in counts[key].values()), None)
    goals = _shared(figures, "name", "goal")
    has_counts = count_in == "row" and any(counts["row"].values())
    head = ["", *([_kind(figures)] if has_counts else [])]
    for name in names:
        count = counts["name"][name] if count_in == "name" else ""
        notes = [f"n = {number(count)}"] if count else []
        notes += [f"goal {goal(goals[name])}"] if goals[name] else []
        title = _titled(name, units["name"][name] if unit_in == "name" else "")
        head.append(title + (f" ({', '.join(notes)})" if notes else ""))
    lines = []
    for row in rows:
        line = [_titled(row, units["row"][row] if unit_in == "row" else "")]
        line += [number(counts["row"][row])] if has_counts else []
        for name in names:
            figure = cells.get((row, name))
            unit = "" if figure is None or unit_in else figure.get("unit", "")
            line.append(_cell(figure, unit, goals[name]))
        lines.append(line)
    return markdown(head, lines)


def _shared(figures: Sequence[Entry], by: str, key: str) -> dict[str, Any]:
    """The value that figures of each row or column share, or None; missing ones are empty."""
    values: dict[str, set[Any]] = {}
    for one in figures:
        values.setdefault(one[by], set()).add(one.get(key, ""))
    return {name: next(iter(some)) if len(some) == 1 else None for name, some in values.items()}


def _kind(figures: Sequence[Entry]) -> str:
    """What the cases of figures are."""
    kinds = {one["of"] for one in figures if "of" in one}
    return kinds.pop() if len(kinds) == 1 else "n"


def _titled(name: str, unit: str | None) -> str:
    return f"{name} [{unit}]" if unit else name


def markdown(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table in Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


# --- key figures


def find(record: str, table: str, row: str, name: str) -> Entry:
    """Find a figure; raise KeyError if there is none."""
    wanted = {"table": table, "row": row, "name": name}
    for figure in read(record)["figures"]:
        if wanted.items() <= figure.items():
            found: Entry = figure
            return found
    raise KeyError(f"results/{record}.json has no figure {table} / {row} / {name}")


def key_figures() -> list[Entry]:
    """Entries of ``key-figures.toml``, each with its figure and record."""
    return [
        one | {"figure": find(*one["at"]), "record": read(one["at"][0])}
        for one in _chosen()["figure"]
    ]


@cache
def _chosen() -> dict[str, list[Entry]]:
    return tomllib.loads((ROOT / "docs" / "key-figures.toml").read_text(encoding="utf-8"))


def _value(figure: Entry) -> str:
    level = f", {figure['level']} %" if "level" in figure else ""
    return shown(figure, figure.get("unit", "")) + level


def _cases(figure: Entry) -> str:
    """The number of cases of a figure, and what they are."""
    return f"{figure['n']:,} {figure.get('of', '')}".strip() if "n" in figure else ""


def _reference(key: Entry) -> str:
    """What a key figure is compared with, and the published figure next to it."""
    parts = [key["figure"]["compared_with"]] if "compared_with" in key["figure"] else []
    if "published" in key:
        published = find("published", "Published figures", *key["published"])
        cases = _cases(published)
        parts.append(f"{key['published'][0]}: {_value(published)}{f' ({cases})' * bool(cases)}")
    return "; ".join(parts)


def _missed(figure: Entry) -> str:
    return goal(figure["goal"]) if is_missed(figure) else ""


KEY_HEAD = ["figure", "value", "n", "compared with", "goal, if missed"]


def _key_row(key: Entry) -> list[str]:
    figure = key["figure"]
    value = shown(figure, figure.get("unit", ""))
    return [key["what"], value, _cases(figure), _reference(key), _missed(figure)]


def key_table(prefix: str = "") -> str:
    """The key figures, and below them their runs; links to topic pages begin with ``prefix``."""
    pages, keys = topic_pages(), key_figures()
    runs = list(dict.fromkeys(key["at"][0] for key in keys))
    rows = []
    for key in keys:
        run = key["at"][0]
        what, _, *cells = _key_row(key)
        link = f"[{what}]({prefix}{pages[run]})"
        rows.append(
            [link, _value(key["figure"]), *cells, key["record"]["date"], str(runs.index(run) + 1)]
        )
    figures = markdown([*KEY_HEAD, "date", "run"], rows)
    origins = [
        [str(number), f"`{one['command']}`", place(one)]
        for number, one in enumerate(map(read, runs), 1)
    ]
    return f"{figures}\n\n{markdown(['run', 'command', 'date, commit and machine'], origins)}"


def readme_table() -> str:
    """The key figures of README."""
    rows = [_key_row(key) for key in key_figures() if key.get("in_readme")]
    return markdown(KEY_HEAD, rows)


def comparison_table() -> str:
    """Errors and accuracies of published methods and of heliotwin."""
    rows = []
    for one in _chosen()["comparison"]:
        error, accuracy = find(*one["error"]), find(*one["accuracy"])
        reference = error.get("compared_with", "")
        rows.append([one["method"], _value(error), _value(accuracy), _cases(error), reference])
    return markdown(["", "error, median", "flux accuracy", "n", "compared with"], rows)


# --- pages


def fill(text: str) -> str:
    """A page with its blocks of figures inserted."""

    def inserted(found: re.Match[str]) -> str:
        kind, name, titles = found.groups()
        if kind == "figures":
            return block(name, [title for title in titles.splitlines() if title])
        return key_table() if kind == "key-figures" else comparison_table()

    return _BLOCK.sub(inserted, text)


def shown_records(text: str) -> list[str]:
    """Names of the records that a page shows."""
    return [name for kind, name, _ in _BLOCK.findall(text) if kind == "figures"]


def topic_pages() -> dict[str, str]:
    """File name of the topic page of each record."""
    return {
        name: path.name
        for path in sorted((ROOT / SITE).glob("*.md"))
        for name in shown_records(path.read_text(encoding="utf-8"))
    }


def results_page() -> str:
    """RESULTS.md: the overview of the site, with links that hold in the repository."""
    text = (ROOT / SITE / "index.md").read_text(encoding="utf-8")
    text = re.sub(r"\n```\{toctree\}.*?```\n", "", text, flags=re.DOTALL)
    text = text.replace("```{key-figures}\n```", key_table(f"{SITE}/"))
    return re.sub(r"\]\((?!\w+:|docs/)([^)]+)\)", rf"]({SITE}/\1)", text)


def readme(text: str) -> str:
    """README with the current table."""
    return _README.sub(lambda _: readme_table(), text, count=1)


def main() -> None:
    """Write RESULTS.md and the table of README."""
    (ROOT / "RESULTS.md").write_text(results_page(), encoding="utf-8")
    path = ROOT / "README.md"
    path.write_text(readme(path.read_text(encoding="utf-8")), encoding="utf-8")


if __name__ == "__main__":
    main()
