"""How every verb prints: a table, progress on standard error, or a report as JSON."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

from model.errors import InvalidInputError

# Tables and progress go to standard error, so that --json leaves standard output to the report.
console = Console(stderr=True)
AsJson = Annotated[bool, typer.Option("--json", help="Print the report as JSON on standard output.")]


def require_file(path: Path) -> None:
    """Refuse what names a folder where a report is to be written, before any work is done for it."""
    if path.is_dir():
        raise InvalidInputError(f"{path} is a folder; name a file to write to")


@contextmanager
def progress(total: int | None, label: str) -> Iterator[Any]:
    """A progress bar; yields a callback that takes the name of what is being done."""
    columns = (SpinnerColumn(), TextColumn("{task.description:<40}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(label, total=total)

        def step(name: str) -> None:
            bar.update(task, description=f"{label} {name}", advance=1)

        yield step


def show(report: dict[str, Any], as_json: bool, table: Table | None = None) -> None:
    """Print the report: JSON, or its table and what was skipped."""
    if as_json:
        typer.echo(json.dumps(report, indent=1))
        return
    if table is not None:
        Console().print(table)
    for name, reason in report.get("skipped", {}).items():
        console.print(f"skipped {name}: {reason}", style="yellow", highlight=False)


def make_table(title: str, *columns: str) -> Table:
    """An empty table; all columns but the first hold numbers."""
    table = Table(title=title, title_justify="left")
    for index, column in enumerate(columns):
        table.add_column(escape(column), justify="left" if index == 0 else "right")
    return table
