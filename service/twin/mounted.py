"""Stored heliostats on their calibrated mounts: what motors, images and studies are all traced by.

A stored mount holds as long as the heliostat's properties and what the plant's model says of the sun are those that it
was calibrated with.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from datetime import datetime

import numpy as np
from numpy.typing import NDArray
from sqlalchemy.orm import Session

from model.effects import Effect, acting
from model.forecast import altered, suns_under
from model.plant import Heliostat
from model.pointing import CalibratedMount
from model.pointing.kinematics import calibrated
from model.pointing.report import day_of, mount_from_json, parameters_from_json, sun_to_json
from service import store
from service.base.faults import ConflictError
from service.sources.documents import read_heliostat
from service.store import mounts
from service.store.tables import HeliostatRow, MountRow
from service.twin import versions

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class StoredMount:
    """A stored heliostat, as its properties have it, with its calibrated mount and the plant's model's effects.

    ``version`` is None where none was ever calibrated.
    """

    heliostat: Heliostat
    mount: CalibratedMount
    version: int | None
    origin: tuple[float, float, float]
    effects: tuple[Effect, ...] = ()

    def turned(self, moment: datetime | None = None) -> Heliostat:
        """The heliostat as calibrated, at a moment, by default as newly measured."""
        if self.version is None:
            return self.heliostat
        return replace(self.heliostat, mount=self.mount.mount(self.heliostat.mount, day_of(moment)))

    def sun(self, recorded: Array, moment: datetime | None = None) -> Array:
        """Where the sun (3,) stood that was ``recorded``: the mount was calibrated under such."""
        return true_sun(self.effects, recorded, moment, self.origin[0])

    def motors(self, recorded: Array, aim: Array, moment: datetime | None = None) -> Array:
        """Motor positions (2,) [steps] that send the light of a sun (3,), as recorded, to ``aim`` (3,) [m].

        Raises `UnreachableError` where no attitude does, or a drive would go beyond an end of its travel.
        """
        (standing,) = altered([self.turned(moment)], acting(self.effects, moment, self.heliostat.name))
        angles = standing.mount.align(standing.position, self.sun(recorded, moment), aim)
        return standing.mount.motors_from_angles(angles)


def true_sun(effects: Iterable[Effect], recorded: Array, moment: datetime | None, latitude_deg: float) -> Array:
    """Where the sun (3,) stood at a moment by a model's effects, of where it was ``recorded`` (3,)."""
    return np.asarray(suns_under(acting(effects, moment, None), recorded[None], latitude_deg)[0])


def load_mount(
    session: Session, name: str, moment: datetime | None = None, model_version: int | None = None
) -> StoredMount:
    """A heliostat's calibrated mount that knows of a moment, by default the newest, or the one of its properties.

    Raises
    ------
    NotFoundError
        Where there is no such heliostat, or no such version of the plant's model.
    ConflictError
        Where its kinematics have no actuators, or its properties or the model's sun changed since it was calibrated.
    """
    row = store.get_heliostat(session, name)
    return stored_mount(session, row, _knowing(session, row, moment), model_version)


def stored_mount(
    session: Session, row: HeliostatRow, kept: MountRow | None, model_version: int | None = None
) -> StoredMount:
    """A heliostat with one of its mounts, loaded with its document; raises what `load_mount` raises."""
    origin, effects = store.get_plant(session).origin, versions.get_model(session, model_version).effects
    heliostat = with_drives(row, origin)
    if kept is None:
        return StoredMount(heliostat, CalibratedMount.uncalibrated(), None, origin, effects)
    return StoredMount(heliostat, mount_of(row, kept, effects), kept.version, origin, effects)


def _knowing(session: Session, row: HeliostatRow, moment: datetime | None) -> MountRow | None:
    """The newest mount that was calibrated by photographs from before a moment, too: it knows its drives' zeros then.

    The newest of all where none was, or no moment is asked for.
    """
    newest = mounts.find_mount_at(session, row)
    if newest is None or moment is None or _begin(newest) <= moment:
        return newest
    every = mounts.list_mounts(session, row, newest.version)[::-1]
    holding = (kept for kept in every if row.updated_at <= kept.created_at)
    return next((kept for kept in holding if _begin(kept) <= moment), newest)


def _begin(kept: MountRow) -> datetime:
    """The first photograph that it was calibrated by."""
    return datetime.fromisoformat(kept.document["history"]["at"][0])


def with_drives(row: HeliostatRow, origin: tuple[float, float, float]) -> Heliostat:
    """The heliostat as its properties have it; ConflictError where it has no drives."""
    heliostat = read_heliostat(row.name, row.properties, np.array(origin))
    if heliostat.mount.actuators is None:
        raise ConflictError(
            "its kinematics have no linear actuators, so motor positions say nothing of its angles; "
            "PUT properties that have kinematics_properties.actuators"
        )
    return heliostat


def mount_of(row: HeliostatRow, kept: MountRow, effects: Iterable[Effect]) -> CalibratedMount:
    """The mount of a document; ConflictError where it does not hold any more for its heliostat and a model."""
    changed = _changed(row, kept, effects)
    if changed is not None:
        raise ConflictError(f"{changed}; POST /v1/jobs/calibrations")
    return mount_from_json(kept.document, f"mount {kept.version} of {row.name}")


def holding_mount(session: Session, row: HeliostatRow) -> StoredMount | None:
    """The newest calibrated mount of a heliostat, where it has one that holds."""
    kept, effects = mounts.find_mount_at(session, row), versions.get_model(session).effects
    return None if kept is None or _changed(row, kept, effects) is not None else stored_mount(session, row, kept)


def _changed(row: HeliostatRow, kept: MountRow, effects: Iterable[Effect]) -> str | None:
    if row.updated_at > kept.created_at:
        return f"the properties of {row.name} changed since it was calibrated"
    # Mounts that do not say were calibrated under suns as recorded.
    if kept.document.get("sun", []) != sun_to_json(effects):
        return f"the plant's model moves the sun otherwise than when {row.name} was calibrated"
    return None


def standing(row: HeliostatRow, kept: MountRow | None, origin: Iterable[float], effects: Iterable[Effect]) -> Heliostat:
    """A heliostat as it stands: on its mount as calibrated where that holds, else as its properties have it.

    Who turns it by its motors wants the zeros of its drives at the time, too: `StoredMount.turned`.
    """
    heliostat = read_heliostat(row.name, row.properties, np.array(origin))
    if kept is None or heliostat.mount.actuators is None or _changed(row, kept, effects) is not None:
        return heliostat
    parameters = parameters_from_json(kept.document, f"mount {kept.version} of {row.name}")
    until = datetime.fromisoformat(kept.document["history"]["at"][-1]).date()
    return replace(heliostat, mount=replace(calibrated(heliostat.mount, parameters), calibrated_until=until))
