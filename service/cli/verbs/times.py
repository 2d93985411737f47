"""The command ``heliotwin times``: add times to stored measurements."""

import csv
import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from model.errors import InvalidInputError
from service.cli.output import AsJson
from service.cli.store import actor, require_reason

if TYPE_CHECKING:
    from service.twin.photographs.corrections import GivenTime

app = typer.Typer()

_COLUMNS = ("heliostat", "id", "taken_at")


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
    from service.base.settings import Settings
    from service.store.database import require_store
    from service.twin.photographs.corrections import correct_times
    from service.twin.runtime.runtime import Runtime

    given = read_times(file)
    require_reason(reason)
    settings = Settings()
    require_store(settings)
    runtime = Runtime.from_settings(settings)
    try:
        runtime.database.require_current()
        changed = correct_times(runtime, given, reason, actor())
    finally:
        runtime.close()
    report = {"given": len(given), "changed": changed}
    typer.echo(json.dumps(report) if as_json else f"{len(given)} times, {changed} of them new")


def read_times(file: Path) -> list["GivenTime"]:
    """The times of a CSV file; InvalidInputError names the first line that is wrong."""
    from pydantic import TypeAdapter, ValidationError

    from service.base.fields import Moment
    from service.base.validation_messages import format_validation_error
    from service.sources.files import require_regular
    from service.twin.photographs.corrections import GivenTime

    moment, found = TypeAdapter(Moment), []
    with require_regular(file).open(encoding="utf-8-sig", newline="") as lines:
        reader = csv.DictReader(lines)
        if not set(_COLUMNS) <= set(reader.fieldnames or ()):
            raise InvalidInputError(
                f"{file}: needs the columns {', '.join(_COLUMNS)} in its first line"
            )
        for row in reader:
            try:
                taken_at = moment.validate_python(row["taken_at"])
            except ValidationError as error:
                raise InvalidInputError(
                    f"{file}, line {reader.line_num}: {format_validation_error(error, 'taken_at')}"
                ) from None
            found.append(GivenTime(row["heliostat"] or "", row["id"] or "", taken_at))
    if not found:
        raise InvalidInputError(f"{file}: holds no time")
    return found
