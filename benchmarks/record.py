"""Figures of a benchmark as JSON: ``results/NAME.json``, from the values that it prints.

    with recording("sun"):
        log_row("Recorded suns", "0 to 10 deg", {"median [mrad]": 0.015}, n=17)

`log_row` does nothing outside of a `recording`, so that other programs may call the same functions.
``HELIOTWIN_RESULTS`` names another folder, for a run with fewer cases than the published one.
"""

import json
import math
import os
import platform
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

ROOT = Path(__file__).parents[1]
RESULTS = Path(os.environ.get("HELIOTWIN_RESULTS", ROOT / "results"))
PRODUCT = ("model", "service", "training", "heliotwin")
"""Packages whose last change is the commit of a record."""

DIGITS = 6
"""Significant digits of a value in a record."""

_figures: ContextVar[list[dict[str, Any]] | None] = ContextVar("figures", default=None)


@dataclass(frozen=True)
class Estimate:
    """A value that has an interval or a goal.

    Attributes
    ----------
    value : number or text
    interval : sequence of float, optional
        Its lower and upper end.
    level : int
        Confidence of the interval [%].
    goal : str, optional
        What the value should be: ``"<= 0.05"`` or ``">= 0.9"``.
    n : int, optional
        Number of cases behind it, if it is not that of the row.
    std : float, optional
        Standard deviation of the values behind it.
    """

    value: Any
    interval: Sequence[float] | None = None
    level: int = 95
    goal: str | None = None
    n: int | None = None
    std: float | None = None


def proportion(count: int, n: int, goal: str | None = None) -> Estimate:
    """The share of ``count`` in ``n`` cases [%], with its 95 % interval (Wilson 1927)."""
    ends = binomtest(count, n).proportion_ci(0.95, method="wilson")
    return Estimate(100 * count / n, (100 * ends.low, 100 * ends.high), goal=goal)


def log_row(
    table: str,
    row: str,
    cells: Mapping[str, Any],
    *,
    n: int | None = None,
    of: str | None = None,
    compared_with: str | None = None,
) -> None:
    """Record a row of a table.

    Parameters
    ----------
    table : str
        Title of the table.
    row : str
        Name of the row.
    cells : mapping of str to value or `Estimate`
        By name, with the unit in brackets: ``"median [mrad]"``. A row may have the unit instead.
        None and NaN are left out.
    n, of : int and str, optional
        Number of cases behind the row, and what they are: ``n=85, of="photographs"``.
    compared_with : str, optional
        Truth or reference of the figures.
    """
    if (figures := _figures.get()) is None:
        return
    label, row_unit = _split(row)
    for title, cell in cells.items():
        figure = cell if isinstance(cell, Estimate) else Estimate(cell)
        if (value := _plain(figure.value)) is None:
            continue
        name, unit = _split(title)
        entry = {"table": table, "row": label, "name": name, "value": value}
        entry |= {
            "unit": unit or row_unit,
            "n": n if figure.n is None else figure.n,
            "of": of,
            "interval": figure.interval and [_plain(end) for end in figure.interval],
            "level": figure.level if figure.interval else None,
            "compared_with": compared_with,
            "goal": figure.goal,
            "std": _plain(figure.std),
        }
        figures.append({key: one for key, one in entry.items() if one is not None})


@contextmanager
def recording(name: str) -> Iterator[None]:
    """Write the rows that are logged meanwhile to ``results/NAME.json``, if there are any."""
    record = {"name": name, "command": command(), "date": f"{datetime.now(UTC):%Y-%m-%d}"}
    measured = {"commit": commit(), "machine": machine()}
    figures: list[dict[str, Any]] = []
    token = _figures.set(figures)
    try:
        yield
    finally:
        _figures.reset(token)
    if figures:
        write({**record, **measured, "figures": figures})


def write(record: Mapping[str, Any]) -> None:
    """Write a record with one figure a line."""
    head = json.dumps({key: one for key, one in record.items() if key != "figures"}, indent=1)
    lines = ",\n  ".join(json.dumps(one, ensure_ascii=False) for one in record["figures"])
    text = f'{head.removesuffix("}").rstrip()},\n "figures": [\n  {lines}\n ]\n}}\n'
    (RESULTS / f"{record['name']}.json").write_text(text, encoding="utf-8")


def command() -> str:
    """The command that runs, without absolute paths."""
    spec = getattr(sys.modules["__main__"], "__spec__", None)
    module = "" if spec is None else spec.name.removesuffix(".__main__")
    arguments = [Path(one).name if one.startswith("/") else one for one in sys.argv[1:]]
    return f"python -m {module} {shlex.join(arguments)}".strip()


def commit() -> str:
    """The last commit that changed the product, with ``+`` if its files have changed since."""
    changed = _git("status", "--porcelain", "--", *PRODUCT)
    return _git("log", "-1", "--format=%h", "--", *PRODUCT) + "+" * bool(changed)


def _git(*arguments: str) -> str:
    done = subprocess.run(
        ["git", "-C", str(ROOT), *arguments], capture_output=True, text=True, check=True
    )
    return done.stdout.strip()


def machine() -> dict[str, Any]:
    """Number of cores, name of the processor, and the load when the run began."""
    described = Path("/proc/cpuinfo")
    text = described.read_text(encoding="utf-8") if described.exists() else ""
    found = re.search(r"^model name\s*:\s*(.*)$", text, re.MULTILINE)
    processor = found[1] if found else platform.processor()
    return {
        "cores": os.cpu_count(),
        "processor": " ".join(processor.split()),
        "load": round(os.getloadavg()[0], 1),
    }


def _split(title: str) -> tuple[str, str | None]:
    """A name and the unit in brackets behind it."""
    found = re.fullmatch(r"(.*?)\s*\[([^\]]+)\]", title)
    return (found[1], found[2]) if found else (title, None)


def _plain(value: Any) -> Any:
    """A number or text for JSON; None if it is NaN."""
    if isinstance(value, np.generic):
        value = value.item()
    if not isinstance(value, float):
        return value
    return float(f"{value:.{DIGITS}g}") if math.isfinite(value) else None
