"""When and where an effect acts: always, since a date, or on each day by values of its own; everywhere or not.

A mirror is canted anew, a camera is set anew: from that date on the plant is another one. Haze and wind come and go:
each day has its own. Days are those of the photographs' times, in the zone that these are recorded in. What mirror and
drive do, one heliostat may have alone.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import date, datetime
from typing import Any

from model.errors import InvalidInputError


@dataclass(frozen=True)
class Always:
    """The whole set, or all photographs of some ``heliostats``; None for all."""

    heliostats: tuple[str, ...] | None = None

    def phase(self, taken_at: datetime | None, heliostat: str | None) -> date | bool:
        """What photographs must share for the effect to be the same in them; False where it does not act."""
        return self.heliostats is None or heliostat in self.heliostats

    def to_json(self) -> dict[str, Any]:
        """As DESIGN.md, section 7, has it; without ``heliostats`` where all have it."""
        return {"kind": "set"} | ({} if self.heliostats is None else {"heliostats": list(self.heliostats)})


@dataclass(frozen=True)
class Since:
    """From the first photograph of ``since`` on, of some ``heliostats`` or all; what is of no time is of today."""

    since: date
    heliostats: tuple[str, ...] | None = None

    def phase(self, taken_at: datetime | None, heliostat: str | None) -> date | bool:
        """As `Always.phase`."""
        theirs = self.heliostats is None or heliostat in self.heliostats
        return theirs and (taken_at is None or taken_at.date() >= self.since)

    def to_json(self) -> dict[str, Any]:
        """As DESIGN.md, section 7, has it; null where all heliostats, or the camera, have it."""
        named = None if self.heliostats is None else list(self.heliostats)
        return {"kind": "since", "since": self.since.isoformat(), "heliostats": named}


@dataclass(frozen=True)
class ByDay:
    """Each day by values of its own.

    Attributes
    ----------
    by_day : mapping
        Day to the values of parameters by their names; on other days the effect's own hold.
    """

    by_day: Mapping[date, Mapping[str, float]] = field(default_factory=dict)

    def phase(self, taken_at: datetime | None, heliostat: str | None) -> date | bool:
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
    given = {"kind": "set"} if data is None else data
    if not isinstance(given, Mapping) or given.get("kind") not in ("set", "since", "day"):
        raise InvalidInputError(
            f'effect {effect}: \'scope\' must be {{"kind": "set"}}, {{"kind": "since", "since": DATE}} or '
            f'{{"kind": "day"}}, got {str(data)[:80]}'
        )
    heliostats = _heliostats_from_json(given.get("heliostats"), effect)
    if given["kind"] == "set":
        return Always(heliostats)
    if given["kind"] == "since":
        return Since(day_from_json(given.get("since"), effect), heliostats)
    if heliostats is not None:
        raise InvalidInputError(f"effect {effect}: a scope by day is of all heliostats; leave its 'heliostats' out")
    return ByDay()


def _heliostats_from_json(data: object, effect: str) -> tuple[str, ...] | None:
    """Names, sorted; None for all."""
    if data is None:
        return None
    if not isinstance(data, list) or not data or not all(isinstance(name, str) for name in data):
        raise InvalidInputError(
            f"effect {effect}: the scope's 'heliostats' must be a list of names, or null for all, got {str(data)[:80]}"
        )
    return tuple(sorted(set(data)))


def day_from_json(data: object, effect: str) -> date:
    """A day; InvalidInputError where it is none."""
    try:
        return date.fromisoformat(str(data))
    except ValueError:
        raise InvalidInputError(
            f"effect {effect}: a day must be a date such as 2024-06-02, got {str(data)[:80]}"
        ) from None
