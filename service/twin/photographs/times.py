"""Times and motor positions of many photographs, given afterwards as lines, or by an offset."""

from collections.abc import Callable, Iterable
from dataclasses import replace
from datetime import datetime, timedelta
from zoneinfo import ZoneInfo

from pydantic import TypeAdapter, ValidationError
from sqlalchemy.orm import Session

from model.errors import InvalidInputError
from service.base.fields import Moment, read_time
from service.base.validation_messages import format_validation_error
from service.sources.text_lines import ForeignLine, csv_lines
from service.store.photographs import PhotographFilter, list_groups
from service.twin.photographs.batches import MOST_ENTRIES
from service.twin.photographs.corrections import GivenCorrection

_MOMENT = TypeAdapter(Moment)


def given_time(heliostat: str, identifier: str, at: datetime, reason: str) -> GivenCorrection:
    """The time of a heliostat's measurement, submitted later."""
    return GivenCorrection(heliostat, identifier, reason, taken_at=at)


def read_times(
    lines: Iterable[str], where: str, reason: str, zone: str | None = None
) -> list[GivenCorrection]:
    """Times of CSV lines with the columns heliostat, id, taken_at.

    Times without a zone are of ``zone``, and are refused without one. The heading may be missing.

    Raises
    ------
    InvalidInputError
        With ``where`` and the first line that is wrong.
    """

    def correction(row: dict[str, str]) -> GivenCorrection:
        at = _MOMENT.validate_python(_with_zone(row["taken_at"], zone))
        return given_time(row["heliostat"], row["id"], at, reason)

    return _read(lines, where, ("heliostat", "id", "taken_at"), correction)


def read_motors(lines: Iterable[str], where: str, reason: str) -> list[GivenCorrection]:
    """Motor positions [steps] of CSV lines with the columns heliostat, id, motor_1, motor_2.

    The heading may be missing; the errors are those of `read_times`.
    """

    def correction(row: dict[str, str]) -> GivenCorrection:
        steps = TypeAdapter(tuple[float, float]).validate_python((row["motor_1"], row["motor_2"]))
        if not all(abs(one) <= 1e9 for one in steps):
            raise InvalidInputError("motor positions must lie between -1e9 and 1e9 steps")
        return GivenCorrection(row["heliostat"], row["id"], reason, motor_position=steps)

    return _read(lines, where, ("heliostat", "id", "motor_1", "motor_2"), correction)


def _read(
    lines: Iterable[str],
    where: str,
    columns: tuple[str, ...],
    correction: Callable[[dict[str, str]], GivenCorrection],
) -> list[GivenCorrection]:
    text = "\n".join(line.rstrip("\r\n") for line in lines)
    first, *rows = [*csv_lines(where, text)] or [ForeignLine(where, columns)]
    names = first.cells
    if len(names) == len(columns) and names[-1].lstrip("-")[:1].isdigit():  # there is no heading
        names, rows = columns, [first, *rows]
    if not {*columns} <= {*names}:
        raise InvalidInputError(
            f"{where}: needs the columns {', '.join(columns)} in its first line"
        )
    found = []
    for line in rows:
        if len(line.cells) != len(names):
            raise line.refuse(f"has {len(line.cells)} cells, {len(names)} are the columns")
        row = dict(zip(names, line.cells, strict=True))
        try:
            found.append(correction(row))
        except (ValidationError, InvalidInputError) as error:
            said = (
                format_validation_error(error, columns[-1])
                if isinstance(error, ValidationError)
                else str(error)
            )
            raise line.refuse(said) from None
    if not found:
        raise InvalidInputError(f"{where}: holds no {'time' if 'taken_at' in columns else 'motor'}")
    return found


def _with_zone(text: str, zone: str | None) -> object:
    """A time without a zone as one of ``zone``; other text as it is."""
    try:
        at = read_time(text)
    except ValueError:
        return text
    return at.replace(tzinfo=ZoneInfo(zone)) if zone and at.tzinfo is None else text


def shifted_times(
    session: Session, chosen: PhotographFilter, minutes: float, reason: str
) -> list[GivenCorrection]:
    """The times of a selection's photographs, ``minutes`` later.

    Raises
    ------
    InvalidInputError
        If it has no photograph of a known time, or too many.
    """
    groups = list_groups(session, replace(chosen, is_dated=True), MOST_ENTRIES + 1)
    if not 0 < len(groups) <= MOST_ENTRIES:
        raise InvalidInputError(
            f"selection: {f'more than {MOST_ENTRIES}' if groups else 'no'} photographs of a known"
            " time; choose another heliostat, target or days"
        )
    offset = timedelta(minutes=minutes)
    return [
        given_time(group.heliostat, group.best.identifier, group.best.taken_at + offset, reason)
        for group in groups
        if group.best.taken_at is not None
    ]
