"""The command ``heliotwin times``: add times to stored measurements."""

import json
from pathlib import Path
from typing import Annotated

import typer

from heliotwin.cli.output import AsJson
from heliotwin.cli.store import actor, open_runtime, require_reason

app = typer.Typer()


@app.command()
def times(
    file: Annotated[
        Path,
        typer.Argument(
            help="CSV with the columns heliostat, id, taken_at (ISO 8601, with zone).",
            metavar="FILE",
        ),
    ],
    reason: Annotated[str, typer.Option(help="Where they come from; kept with each correction.")],
    as_json: AsJson = False,
) -> None:
    """Set the times of stored measurements, all or none; each is stored as a correction."""
    from service.base.validation import counted
    from service.sources.files import require_regular
    from service.twin.photographs.batches import TIMES, correct_many, read_times

    with require_regular(file).open(encoding="utf-8-sig", newline="") as lines:
        given = read_times(lines, str(file), reason)
    require_reason(reason)
    with open_runtime() as runtime:
        changed = correct_many(runtime, given, reason, actor(), TIMES)
    report = {"given": len(given), "changed": changed}
    typer.echo(json.dumps(report) if as_json else f"{counted(len(given), 'time')}, {changed} new")
