"""Output of all verbs: a table, progress on standard error, or a report as JSON."""

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any
from unicodedata import normalize

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

from model.errors import InvalidInputError

if TYPE_CHECKING:
    from service.sources.folder import MeasurementFolder

# Progress goes to standard error, so that --json leaves standard output to the report.
console = Console(stderr=True)
AsJson = Annotated[
    bool, typer.Option("--json", help="Print the report as JSON on standard output.")
]


def _time(text: str) -> datetime:
    from service.base.fields import read_time

    try:
        return read_time(text)
    except ValueError:
        raise typer.BadParameter(
            f"{text!r} is no time; give it as 2026-06-21T13:00, or 2026-06-21T13:00:00.5+02:00"
        ) from None


AtTime = Annotated[
    datetime | None,
    typer.Option(
        help="The sun at a time, in UTC unless it has a zone.", metavar="TIME", parser=_time
    ),
]


def require_file(path: Path) -> None:
    """Check, before any work is done, that a report file can be written here."""
    if path.is_dir():
        raise InvalidInputError(f"{path} is a folder; name a file to write to")
    require_folder(path.parent)


def require_folder(path: Path) -> None:
    """Check, before any work is done, that this is or can become a folder."""
    there = next(place for place in (path, *path.absolute().parents) if place.exists())
    if not there.is_dir():
        raise InvalidInputError(f"{there} is a file; name a folder to write to")


@contextmanager
def progress(total: int | None, label: str) -> Iterator[Any]:
    """Progress bar; yields a callback that takes the name of the current item."""
    columns = (
        SpinnerColumn(),
        TextColumn("{task.description:<40}"),
        BarColumn(),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(label, total=total)

        def step(name: str) -> None:
            bar.update(task, description=f"{label} {name}", advance=1)

        yield step


def show(report: Mapping[str, Any], as_json: bool, table: Table | None = None) -> None:
    """Print the report as JSON, or its warnings, its table and the skipped items."""
    if as_json:
        typer.echo(json.dumps(report, indent=1))
        return
    for warning in report.get("warnings", ()):
        Console().print(warning, style="yellow", highlight=False)
    if table is not None:
        Console().print(table)
    _show_skipped(report.get("skipped", {}))


# Most items with the same reason that are listed in full; of more items, this many are examples.
_EXAMPLES = 3


def _show_skipped(skipped: Mapping[str, str]) -> None:
    """Print what was skipped, by reason; ``--json`` lists all of it."""
    by_reason: dict[str, list[str]] = {}
    for name, reason in skipped.items():
        by_reason.setdefault(reason, []).append(name)
    for reason, names in by_reason.items():
        if len(names) <= _EXAMPLES:
            lines = [f"skipped {name}: {reason}" for name in names]
        else:
            lines = [f"skipped {len(names):,}: {reason} ({', '.join(names[:_EXAMPLES])}, ..)"]
        for line in lines:
            console.print(line, style="yellow", highlight=False)


def require_unbroken(folder: "MeasurementFolder") -> None:
    """Raise InvalidInputError if a file of a heliostat is broken.

    Call it after all other work. A heliostat with missing data is skipped without an error. A file
    that cannot be read is an error.
    """
    if folder.broken:
        first, others = next(iter(folder.broken.values())), len(folder.broken) - 1
        more = f", and {others} more such files" if others else ""
        raise InvalidInputError(f"{first}{more}; all but {', '.join(folder.broken)} is done")


_LABELS = {
    "peak_p95_w_m2": "peak in 95 % of cases",
    "single_aim_power_w": "power if all aim at the middle",
    "bound_w": "no aims give more than",
}


def quantity_table(title: str, figures: Mapping[str, Any]) -> Table:
    """A table of numbers by names that end with their units."""
    table = make_table(title, "quantity", "value")
    for name, value in figures.items():
        label = _LABELS.get(name, name.removesuffix("_m2").removesuffix("_w").replace("_", " "))
        table.add_row(label, quantity_text(name, value))
    return table


def quantity_text(name: str, value: float) -> str:
    """A number in three figures, with the unit at the end of its name, as terminals show it."""
    from service.drawing.templates import quantity

    return normalize("NFKC", quantity(name, value))


def make_table(title: str, *columns: str) -> Table:
    """An empty table; all columns but the first hold numbers."""
    table = Table(title=title, title_justify="left")
    for index, column in enumerate(columns):
        table.add_column(escape(column), justify="left" if index == 0 else "right")
    return table
