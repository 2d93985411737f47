"""When an effect acts: always, since a date, or on each day by values of its own.

A mirror is canted anew, a camera is set anew: from that date on the plant is another one. Haze and wind come and go:
each day has its own. Days are those of the photographs' times, in the zone that these are recorded in.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import date, datetime
from typing import Any

from model.errors import InvalidInputError


@dataclass(frozen=True)
class Always:
    """The whole set."""

    def phase(self, taken_at: datetime | None) -> date | bool:
        """What photographs must share for the effect to be the same in them; False where it does not act."""
        return True

    def to_json(self) -> dict[str, Any]:
        """As DESIGN.md, section 7, has it."""
        return {"kind": "set"}


@dataclass(frozen=True)
class Since:
    """From the first photograph of ``since`` on; what is of no known time is of today."""

    since: date

    def phase(self, taken_at: datetime | None) -> date | bool:
        """As `Always.phase`."""
        return taken_at is None or taken_at.date() >= self.since

    def to_json(self) -> dict[str, Any]:
        """As DESIGN.md, section 7, has it, but for the heliostats, which the effect knows."""
        return {"kind": "since", "since": self.since.isoformat()}


@dataclass(frozen=True)
class ByDay:
    """Each day by values of its own.

    Attributes
    ----------
    by_day : mapping
        Day to the values of parameters by their names; on other days the effect's own hold.
    """

    by_day: Mapping[date, Mapping[str, float]] = field(default_factory=dict)

    def phase(self, taken_at: datetime | None) -> date | bool:
        """As `Always.phase`."""
        day = None if taken_at is None else taken_at.date()
        return day if day is not None and day in self.by_day else True

    def to_json(self) -> dict[str, Any]:
        """As DESIGN.md, section 7, has it; the values stand beside the parameters."""
        return {"kind": "day"}


Scope = Always | Since | ByDay


def scope_from_json(data: object, effect: str) -> Scope:
    """A scope without its values; `Always` where none is given.

    Raises
    ------
    InvalidInputError
        Where it is none.
    """
    kind = "set" if data is None else data.get("kind") if isinstance(data, Mapping) else None
    if kind == "set":
        return Always()
    if kind == "day":
        return ByDay()
    if kind == "since":
        assert isinstance(data, Mapping)
        return Since(day_from_json(data.get("since"), effect))
    raise InvalidInputError(
        f'effect {effect}: \'scope\' must be {{"kind": "set"}}, {{"kind": "since", "since": DATE}} or '
        f'{{"kind": "day"}}, got {str(data)[:80]}'
    )


def day_from_json(data: object, effect: str) -> date:
    """A day; InvalidInputError where it is none."""
    try:
        return date.fromisoformat(str(data))
    except ValueError:
        raise InvalidInputError(
            f"effect {effect}: a day must be a date such as 2024-06-02, got {str(data)[:80]}"
        ) from None
