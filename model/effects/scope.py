"""Scope of an effect: always, since a date, or by day, for all heliostats or some.

If a mirror is canted again, or a camera has new settings, the plant is different from that date on.
Haze of a week, or a mirror that is cleaned, ends on another date.
Haze and wind change from day to day, so each day has separate values. Days are those of the
photographs' times, in their recorded time zone. An effect of mirror or drive may belong to a single
heliostat.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import date, datetime
from typing import Any

from model.errors import InvalidInputError


@dataclass(frozen=True)
class Always:
    """All photographs, or all of some ``heliostats``; None for all heliostats."""

    heliostats: tuple[str, ...] | None = None

    def phase(self, taken_at: datetime | None, heliostat: str | None) -> date | bool:
        """The phase in which photographs have the same effect; False if it does not act."""
        return self.heliostats is None or heliostat in self.heliostats

    def to_json(self) -> dict[str, Any]:
        """The scope as JSON; without ``heliostats`` if all have the effect."""
        return {"kind": "set"} | (
            {} if self.heliostats is None else {"heliostats": list(self.heliostats)}
        )


@dataclass(frozen=True)
class Since:
    """From the date ``since`` on, for some ``heliostats`` or all.

    ``until`` is the first day without the effect; None while it acts. A photograph without a time
    counts as current.

    Raises
    ------
    InvalidInputError
        If it ends before it begins.
    """

    since: date
    heliostats: tuple[str, ...] | None = None
    until: date | None = None

    def __post_init__(self) -> None:
        if self.until is not None and self.until <= self.since:
            raise InvalidInputError(
                f"a scope since {self.since} must end after that day, got {self.until}"
            )

    def acts_at(self, taken_at: datetime | None) -> bool:
        """Whether it acts at a time; None is the present."""
        if taken_at is None:
            return self.until is None
        day = taken_at.date()
        return self.since <= day and (self.until is None or day < self.until)

    def phase(self, taken_at: datetime | None, heliostat: str | None) -> date | bool:
        """As `Always.phase`."""
        theirs = self.heliostats is None or heliostat in self.heliostats
        return theirs and self.acts_at(taken_at)

    def to_json(self) -> dict[str, Any]:
        """The scope as JSON; ``heliostats`` is null if all, or the camera, have the effect."""
        named = None if self.heliostats is None else list(self.heliostats)
        until = None if self.until is None else self.until.isoformat()
        return {
            "kind": "since",
            "since": self.since.isoformat(),
            "until": until,
            "heliostats": named,
        }


@dataclass(frozen=True)
class ByDay:
    """Separate values for each day.

    Attributes
    ----------
    by_day : mapping
        Day to parameter values by name; on other days, the effect's own values count.
    until : date or None
        First of the other days without the effect; None while it acts.
    """

    by_day: Mapping[date, Mapping[str, float]] = field(default_factory=dict)
    until: date | None = None

    def phase(self, taken_at: datetime | None, heliostat: str | None) -> date | bool:
        """As `Always.phase`."""
        day = None if taken_at is None else taken_at.date()
        if day is not None and day in self.by_day:
            return day
        return self.until is None or (day is not None and day < self.until)

    def to_json(self) -> dict[str, Any]:
        """The scope as JSON; the values are with the parameters."""
        until = {} if self.until is None else {"until": self.until.isoformat()}
        return {"kind": "day"} | until


Scope = Always | Since | ByDay


def scope_from_json(data: object, effect: str) -> Scope:
    """Parse a scope without its values; `Always` if none is given.

    Raises
    ------
    InvalidInputError
        If it is malformed.
    """
    given = {"kind": "set"} if data is None else data
    if not isinstance(given, Mapping) or given.get("kind") not in ("set", "since", "day"):
        raise InvalidInputError(
            f'effect {effect}: \'scope\' must be {{"kind": "set"}}, {{"kind": "since", "since":'
            f' DATE}} or {{"kind": "day"}}, got {str(data)[:80]}'
        )
    heliostats = _heliostats_from_json(given.get("heliostats"), effect)
    if given["kind"] == "set":
        return Always(heliostats)
    until = None if given.get("until") is None else day_from_json(given["until"], effect)
    if given["kind"] == "since":
        return Since(day_from_json(given.get("since"), effect), heliostats, until)
    if heliostats is not None:
        raise InvalidInputError(
            f"effect {effect}: a scope by day is of all heliostats; leave its 'heliostats' out"
        )
    return ByDay(until=until)


def _heliostats_from_json(data: object, effect: str) -> tuple[str, ...] | None:
    """Sorted names; None for all."""
    if data is None:
        return None
    if not isinstance(data, list) or not data or not all(isinstance(name, str) for name in data):
        raise InvalidInputError(
            f"effect {effect}: the scope's 'heliostats' must be a list of names, or null for all,"
            f" got {str(data)[:80]}"
        )
    return tuple(sorted(set(data)))


def day_from_json(data: object, effect: str) -> date:
    """Parse a day; InvalidInputError if it is malformed."""
    try:
        return date.fromisoformat(str(data))
    except ValueError:
        raise InvalidInputError(
            f"effect {effect}: a day must be a date such as 2024-06-02, got {str(data)[:80]}"
        ) from None
