"""What a plan of aims was computed from, and what of it changed since."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import NotRequired, TypedDict
from zoneinfo import ZoneInfo

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from service import store
from service.store import queue
from service.store.columns import now
from service.store.job_tables import JobRow
from service.store.tables import HeliostatRow, MountRow, PlantRow
from service.twin import model_versions
from service.twin.forecasts.mirror_states import MirrorStates

KIND = "aim-plans"

SOURCES = "sources"
"""Step of a plan's job with its `Sources`."""


def plant_time_zone(session: Session, default: str | None) -> str:
    """The time zone of the plant's file; without one the ``default`` of the settings, or UTC."""
    plant = session.get(PlantRow, 1)
    return (None if plant is None else plant.time_zone) or default or "UTC"


class Sources(TypedDict):
    """Model version, and by heliostat the versions of surface and mount, and its properties' time.

    Versions are None for heliostats without a surface, or never calibrated. ``states`` are measured
    cleanliness [1] and pointing error [mrad], None if not measured.
    """

    model: int
    heliostats: dict[str, list[int | str | None]]
    states: NotRequired[dict[str, list[float | None]]]


def sources_of(session: Session, names: Sequence[str], model: int | None = None) -> Sources:
    """The current sources of heliostats; ``model`` is the version that was asked for, if any."""
    surfaces = store.active_versions(session)
    newest = select(MountRow.heliostat_id, func.max(MountRow.version))
    mounts = {row[0]: row[1] for row in session.execute(newest.group_by(MountRow.heliostat_id))}
    row, wanted = HeliostatRow, set(names)
    found = session.execute(select(row.id, row.name, row.updated_at)).all()
    return {
        "model": model or model_versions.current_number(session),
        "heliostats": {
            name: [surfaces.get(number), mounts.get(number), updated.isoformat()]
            for number, name, updated in found
            if name in wanted
        },
    }


@dataclass(frozen=True)
class OutdatedPlan:
    """A plan of the current day, of which something changed since it was made.

    ``changes`` names the heliostats of each kind of change; ``models`` are the plan's version of
    the model and the current one if they differ.
    """

    job: int
    target: str | None
    made_at: datetime
    changes: Mapping[str, Sequence[str]]
    models: tuple[int, int] | None

    @property
    def heliostats(self) -> list[str]:
        """All heliostats of which something changed."""
        return sorted({name for names in self.changes.values() for name in names})


def has_other_state(
    states: MirrorStates, name: str, clean: float | None, mrad: float | None
) -> bool:
    """Whether a mirror surely has another cleanliness than assumed, or points surely worse."""
    dimmed, error = states.cleanliness.get(name), states.pointing_mrad.get(name)
    if dimmed is None or dimmed.ci95 is None or clean is None:
        is_other = (dimmed is None) != (clean is None)
    else:
        is_other = not dimmed.ci95[0] <= clean <= dimmed.ci95[1]
    is_worse = bool(error and error.ci95 and mrad is not None and mrad < error.ci95[0])
    return is_worse or is_other


_PARTS = ("surface", "mount", "properties")


def outdated_plans(
    session: Session, default_zone: str | None, measure: Callable[[], MirrorStates]
) -> list[OutdatedPlan]:
    """The newest plan of the current day for each target, if something changed since.

    ``measure`` measures the present states of mirrors.
    """
    today = now().astimezone(ZoneInfo(plant_time_zone(session, default_zone))).date().isoformat()
    query = (
        select(JobRow.id, JobRow.payload["target"].as_string(), JobRow.finished_at)
        .where(JobRow.kind == KIND, JobRow.state == "done")
        .where(JobRow.result["date"].as_string() == today)
        .order_by(JobRow.id)
    )
    newest = {target: (job, target, at) for job, target, at in session.execute(query)}
    found = (_outdated(session, measure, *one) for one in newest.values())
    return [one for one in found if one is not None]


def _outdated(
    session: Session,
    measure: Callable[[], MirrorStates],
    job: int,
    target: str | None,
    made_at: datetime,
) -> OutdatedPlan | None:
    before = queue.load_checkpoint(session, job, SOURCES)
    if before is None:
        return None
    current = sources_of(session, list(before["heliostats"]))
    changes: dict[str, list[str]] = {part: [] for part in _PARTS}
    for name, old in before["heliostats"].items():
        new = current["heliostats"].get(name)
        for part, was, is_now in zip(_PARTS, old, new or [None] * len(_PARTS), strict=True):
            if was != is_now:
                changes[part].append(name)
    if assumed := before.get("states"):
        states = measure()
        changes["measured state"] = [
            name for name, values in assumed.items() if has_other_state(states, name, *values)
        ]
    changes = {part: sorted(names) for part, names in changes.items() if names}
    models = before["model"], current["model"]
    is_other = models[0] != models[1]
    if not changes and not is_other:
        return None
    return OutdatedPlan(job, target, made_at, changes, models if is_other else None)
