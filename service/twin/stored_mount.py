"""Stored heliostats: their calibrated mounts for motors, images and studies, and their facets.

A stored mount is valid as long as the heliostat's properties and the model's sun effects are those
of its calibration.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from datetime import datetime

import numpy as np
from numpy.typing import NDArray
from sqlalchemy.orm import Session

from model.effects import Effect, acting, apply_mount_effects
from model.forecast import true_suns
from model.plant import Heliostat
from model.plant_model import PlantModel
from model.pointing import CalibratedMount
from model.pointing.kinematics import apply_parameters
from model.pointing.report import day_of, mount_from_json, parameters_from_json, sun_to_json
from service import store
from service.base.errors import ConflictError
from service.drawing.facets import FacetPlaces
from service.sources.documents import read_heliostat
from service.sources.schema import STORED
from service.store import mounts
from service.store.tables import HeliostatRow, MountRow
from service.twin import model_versions

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class StoredMount:
    """A stored heliostat with its calibrated mount and the plant's model.

    ``heliostat`` is as in its properties. ``version`` is None if the heliostat was never
    calibrated.
    """

    heliostat: Heliostat
    mount: CalibratedMount
    version: int | None
    model: PlantModel

    def turned(self, moment: datetime | None = None) -> Heliostat:
        """The heliostat as calibrated, at a moment, by default as newly measured."""
        if self.version is None:
            return self.heliostat
        return replace(self.heliostat, mount=self.mount.mount(self.heliostat.mount, day_of(moment)))

    def sun(self, recorded: Array, moment: datetime | None = None) -> Array:
        """True direction (3,) of a ``recorded`` sun; mounts are calibrated with true suns."""
        return true_sun(self.model, recorded, moment)

    def motors(self, recorded: Array, aim: Array, moment: datetime | None = None) -> Array:
        """Motor positions (2,) [steps] that reflect a recorded sun (3,) to ``aim`` (3,) [m].

        Raises `UnreachableError` if no attitude does, or a drive would exceed its travel.
        """
        angles = self.axis_angles(recorded, aim, moment)
        return self._standing(moment).mount.motors_from_angles(angles)

    def axis_angles(self, recorded: Array, aim: Array, moment: datetime | None = None) -> Array:
        """Axis angles (2,) [rad] for what `motors` gives the positions of."""
        standing = self._standing(moment)
        return standing.mount.align(standing.position, self.sun(recorded, moment), aim)

    def _standing(self, moment: datetime | None) -> Heliostat:
        """The heliostat as calibrated, with the mount effects of the model."""
        effects = acting(self.model.effects, moment, self.heliostat.name)
        (standing,) = apply_mount_effects([self.turned(moment)], effects)
        return standing


def true_sun(model: PlantModel, recorded: Array, moment: datetime | None) -> Array:
    """True direction (3,) of a ``recorded`` sun (3,) at a moment, by a model's effects."""
    return np.asarray(true_suns(model, recorded[None], moment)[0])


def load_mount(
    session: Session, name: str, moment: datetime | None = None, model_version: int | None = None
) -> StoredMount:
    """Load a heliostat's calibrated mount for a moment, by default the newest.

    A heliostat that was never calibrated has the mount of its properties.

    Raises
    ------
    NotFoundError
        If there is no such heliostat, or no such version of the plant's model.
    ConflictError
        If its kinematics have no actuators, or its properties or the model's sun changed since the
        calibration.
    """
    row = store.get_heliostat(session, name)
    return stored_mount(session, row, _newest_covering(session, row, moment), model_version)


def stored_mount(
    session: Session, row: HeliostatRow, mount: MountRow | None, model_version: int | None = None
) -> StoredMount:
    """Combine a heliostat with one of its mounts, loaded with its document.

    Raises what `load_mount` raises.
    """
    model = model_versions.get_model(session, model_version)
    heliostat = with_drive_zeros(row, model.site.origin)
    if mount is None:
        return StoredMount(heliostat, CalibratedMount.uncalibrated(), None, model)
    return StoredMount(heliostat, mount_of(row, mount, model.effects), mount.version, model)


def _newest_covering(
    session: Session, row: HeliostatRow, moment: datetime | None
) -> MountRow | None:
    """The newest mount whose calibration photographs include some from before a moment.

    Such a mount knows the zeros of its drives at that moment. If there is none, or no moment is
    given, the newest mount is returned.
    """
    newest = mounts.find_mount_at(session, row)
    if newest is None or moment is None or _began_by(newest, moment):
        return newest
    every = mounts.list_mounts(session, row, newest.version)[::-1]
    holding = (mount for mount in every if row.updated_at <= mount.created_at)
    return next((mount for mount in holding if _began_by(mount, moment)), newest)


def _began_by(mount: MountRow, moment: datetime) -> bool:
    """Whether the first calibration photograph of known time came before a moment.

    True if no time is known.
    """
    times = [time for time in mount.document["history"]["at"] if time is not None]
    return not times or datetime.fromisoformat(times[0]) <= moment


def with_drive_zeros(row: HeliostatRow, origin: tuple[float, float, float]) -> Heliostat:
    """The heliostat as in its properties; ConflictError if it has no drives."""
    heliostat = read_heliostat(row.name, row.properties, np.array(origin), STORED)
    if heliostat.mount.actuators is None:
        raise ConflictError(
            "its kinematics have no actuators, so motor positions say nothing of its angles;"
            " PUT properties that have kinematics_properties.actuators, or give the mount's drives"
            " in plant.yaml"
        )
    return heliostat


def mount_of(row: HeliostatRow, mount: MountRow, effects: Iterable[Effect]) -> CalibratedMount:
    """The mount of a stored document.

    Raises ConflictError if the heliostat's properties or the model's sun changed since the
    calibration.
    """
    changed = _changed(row, mount, effects)
    if changed is not None:
        raise ConflictError(f"{changed}; POST /v1/jobs/calibrations")
    return mount_from_json(mount.document, f"mount {mount.version} of {row.name}")


def mount_at(session: Session, row: HeliostatRow) -> StoredMount | None:
    """The newest calibrated mount of a heliostat; None if there is no valid one."""
    mount, effects = mounts.find_mount_at(session, row), model_versions.get_model(session).effects
    return (
        None
        if mount is None or _changed(row, mount, effects) is not None
        else stored_mount(session, row, mount)
    )


def _changed(row: HeliostatRow, mount: MountRow, effects: Iterable[Effect]) -> str | None:
    if row.updated_at > mount.created_at:
        return f"the properties of {row.name} changed since it was calibrated"
    # Mounts without this entry were calibrated with suns as recorded.
    if mount.document.get("sun", []) != sun_to_json(effects):
        return f"the plant's model moves the sun otherwise than when {row.name} was calibrated"
    return None


def as_calibrated(row: HeliostatRow, mount: MountRow | None, model: PlantModel) -> Heliostat:
    """The heliostat on its calibrated mount if that is valid, else as in its properties.

    Motor positions also depend on the zeros of the drives at the time: see `StoredMount.turned`.
    """
    heliostat = read_heliostat(row.name, row.properties, np.array(model.site.origin), STORED)
    if (
        mount is None
        or heliostat.mount.actuators is None
        or _changed(row, mount, model.effects) is not None
    ):
        return heliostat
    parameters = parameters_from_json(mount.document, f"mount {mount.version} of {row.name}")
    newest = mount.document["history"]["at"][-1]
    until = None if newest is None else datetime.fromisoformat(newest).date()
    return replace(
        heliostat,
        mount=replace(apply_parameters(heliostat.mount, parameters), calibrated_until=until),
    )


def facet_places(
    heliostat: HeliostatRow, origin: tuple[float, float, float], count: int
) -> FacetPlaces:
    """Places of the ``count`` facets of a surface; ``origin`` is the tower base in WGS84.

    They are in rows if the heliostat has another number of facets since.
    """
    mirror = read_heliostat(heliostat.name, heliostat.properties, np.array(origin), STORED)
    if len(mirror.facets) != count:
        return FacetPlaces.in_rows(count, heliostat.size_m)
    return FacetPlaces.of(mirror)
