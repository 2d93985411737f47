"""States of mirrors in operation: how clean they are, and how well they point.

Forecasts of the field, plans and aims trace mirrors in the states that photographs measured
(`service.twin.alarms.measured_states`). What nothing measured is as declared.
"""

from collections import Counter
from collections.abc import Container, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, NamedTuple, NotRequired, TypedDict

from model.plant import Heliostat
from service.sources.plant_schema import MAX_HELIOSTATS
from service.sources.plant_tables import CsvColumns, read_rows

STATE_COLUMNS = (
    "name",
    "cleanliness",
    "cleanliness_low",
    "cleanliness_high",
    "pointing_error_mrad",
    "pointing_error_low_mrad",
    "pointing_error_high_mrad",
)
"""Columns of a CSV file of measured states: values with the ends of their intervals."""


class Estimate(NamedTuple):
    """A measured value with its 95 % interval, None if that is not known."""

    value: float
    ci95: tuple[float, float] | None


class StateValue(TypedDict):
    """A value that acts in a forecast, and where it is from."""

    value: float
    source: Literal["measured", "declared", "default"]
    ci95: NotRequired[tuple[float, float] | None]


class MirrorState(TypedDict):
    """Cleanliness [1], and the pointing error's standard deviation per axis [mrad]."""

    cleanliness: StateValue
    pointing_error_mrad: StateValue


_VALUES: tuple[Literal["cleanliness"], Literal["pointing_error_mrad"]] = (
    "cleanliness",
    "pointing_error_mrad",
)
CLEANLINESS_RANGE, MRAD_RANGE = (0.01, 1.0), (0.0, 99.0)
"""Least and largest cleanliness [1] and pointing error [mrad] that act."""


@dataclass(frozen=True)
class MirrorStates:
    """Measured states of a field's mirrors.

    Attributes
    ----------
    cleanliness, pointing_mrad : mapping of heliostat names to Estimate
    default_mrad : float [mrad]
        Pointing error of heliostats that neither measure nor declare one.
    """

    cleanliness: Mapping[str, Estimate] = field(default_factory=dict)
    pointing_mrad: Mapping[str, Estimate] = field(default_factory=dict)
    default_mrad: float = 0.0

    def of(self, heliostat: Heliostat) -> MirrorState:
        """The state of a heliostat, as its properties declare what is not measured."""
        declared = 1e3 * heliostat.optics.pointing_error
        pointing = StateValue(value=declared, source="declared")
        if not declared and self.default_mrad:
            pointing = StateValue(value=self.default_mrad, source="default")
        clean = StateValue(value=heliostat.optics.cleanliness, source="declared")
        name = heliostat.name
        return MirrorState(
            cleanliness=_measured(self.cleanliness.get(name), clean),
            pointing_error_mrad=_measured(self.pointing_mrad.get(name), pointing),
        )

    def in_words(self, name: str) -> list[str]:
        """What was measured of a heliostat, as a sentence; none if nothing was."""
        clean, mrad = self.values_of(name)
        parts = [] if clean is None else [f"its cleanliness {clean:.2f}"]
        parts += [] if mrad is None else [f"its pointing error {mrad:.2f} mrad"]
        verb = "counts" if len(parts) == 1 else "count"
        return [f"as photographs measured, {' and '.join(parts)} {verb}"] if parts else []

    def values_of(self, name: str) -> list[float | None]:
        """Measured cleanliness [1] and pointing error [mrad] of a heliostat; None if not."""
        found = self.cleanliness.get(name), self.pointing_mrad.get(name)
        return [None if one is None else one.value for one in found]


AS_DECLARED = MirrorStates()
"""Nothing is measured."""


def _measured(estimate: Estimate | None, otherwise: StateValue) -> StateValue:
    if estimate is None:
        return otherwise
    return StateValue(value=estimate.value, source="measured", ci95=estimate.ci95)


def in_state(heliostat: Heliostat, state: MirrorState) -> Heliostat:
    """The heliostat with the cleanliness and the pointing error of a state."""
    optics = replace(
        heliostat.optics,
        cleanliness=state["cleanliness"]["value"],
        pointing_error=1e-3 * state["pointing_error_mrad"]["value"],
    )
    return replace(heliostat, optics=optics)


def count_sources(states: Iterable[MirrorState]) -> dict[str, dict[str, int]]:
    """How many values of mirrors are measured, declared and defaults."""
    counts: dict[str, Counter[str]] = {name: Counter() for name in _VALUES}
    for state in states:
        for name in _VALUES:
            counts[name][state[name]["source"]] += 1
    return {name: dict(found) for name, found in counts.items()}


def with_measured(states: Mapping[str, MirrorState]) -> dict[str, MirrorState]:
    """The states that have a measured value, by heliostat."""
    return {
        heliostat: state
        for heliostat, state in states.items()
        if any(state[name]["source"] == "measured" for name in _VALUES)
    }


def state_rows(states: Mapping[str, MirrorState]) -> Iterator[list[str | float | None]]:
    """Rows of `STATE_COLUMNS`; cells of what is not measured are None."""
    for heliostat, state in states.items():
        row: list[str | float | None] = [heliostat]
        for name in _VALUES:
            is_measured = state[name]["source"] == "measured"
            ends = state[name].get("ci95") or (None, None)
            row += [state[name]["value"], *ends] if is_measured else [None] * 3
        yield row


def read_states(path: Path, heliostats: Container[str]) -> MirrorStates:
    """Measured states of a CSV file; empty cells are not measured.

    ``heliostats`` are the names of the plant's. Raises `InvalidInputError`, which names file and
    line.
    """
    found: tuple[dict[str, Estimate], dict[str, Estimate]] = {}, {}
    ranges = CLEANLINESS_RANGE, MRAD_RANGE
    for row in read_rows(path, CsvColumns(STATE_COLUMNS[:1], STATE_COLUMNS[1:]), MAX_HELIOSTATS):
        name = row.cells["name"]
        if name not in heliostats:
            raise row.wrong("name", f"{name[:60]!r} is no heliostat of the plant")
        for values, first, ends in zip(found, (1, 4), ranges, strict=True):
            value, low, high = (row.optional(one, *ends) for one in STATE_COLUMNS[first:][:3])
            if value is not None:
                ci95 = None if low is None or high is None else (low, high)
                values[name] = Estimate(value, ci95)
    return MirrorStates(*found)
