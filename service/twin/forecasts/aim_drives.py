"""Drive positions that put the spots of a plan on its aims, by the calibrated mounts."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import TypedDict

import numpy as np
from numpy.typing import NDArray
from sqlalchemy.orm import Session

from model.errors import ModelError
from model.plant_model import PlantModel
from model.pointing import CalibratedMount
from service import store
from service.base.errors import ConflictError
from service.sources.documents import read_heliostat
from service.sources.schema import STORED
from service.store import mounts
from service.store.tables import HeliostatRow, MountRow
from service.twin.heliostats.stored_mount import StoredMount, mount_of

Array = NDArray[np.float64]


class DriveAim(TypedDict):
    """Motor positions of both axes [steps], or axis angles [deg] of ideal drives, or why neither.

    ``reason`` is None if one of them is known.
    """

    motor_position: list[float] | None
    axis_angles_deg: list[float] | None
    reason: str | None


def no_drive(reason: str) -> DriveAim:
    """Unknown positions, with the reason."""
    return {"motor_position": None, "axis_angles_deg": None, "reason": reason}


@dataclass(frozen=True, eq=False)
class AimDrives:
    """Mounts of heliostats by name, or the reasons why they are not known."""

    mounts: Mapping[str, StoredMount | str]

    @classmethod
    def read(cls, session: Session, names: Sequence[str], model: PlantModel) -> "AimDrives":
        """Read the newest mounts of stored heliostats."""
        calibrated = {row.name: mount for row, mount in mounts.current_mounts(session, names)}
        rows = store.get_heliostats(session, names)
        return cls({name: _mount(row, calibrated.get(name), model) for name, row in rows.items()})

    def of(self, name: str, sun: Array, aim: Array, moment: datetime | None) -> DriveAim:
        """Positions of a heliostat that reflect a recorded sun (3,) to ``aim`` (3,) [m]."""
        mount = self.mounts[name]
        if isinstance(mount, str):
            return no_drive(mount)
        try:
            if mount.heliostat.mount.actuators is None:
                angles = np.degrees(mount.axis_angles(sun, aim, moment)).round(4).tolist()
                return {"motor_position": None, "axis_angles_deg": angles, "reason": None}
            steps = mount.motors(sun, aim, moment).round(2).tolist()
        except ModelError as error:
            return no_drive(str(error))
        return {"motor_position": steps, "axis_angles_deg": None, "reason": None}


def _mount(row: HeliostatRow, mount: MountRow | None, model: PlantModel) -> StoredMount | str:
    try:
        heliostat = read_heliostat(row.name, row.properties, np.array(model.site.origin), STORED)
        if heliostat.mount.actuators is None:
            return StoredMount(heliostat, CalibratedMount.uncalibrated(), None, model)
        if mount is None:
            return "its mount was never calibrated; POST /v1/jobs/calibrations"
        return StoredMount(heliostat, mount_of(row, mount, model.effects), mount.version, model)
    except (ModelError, ConflictError) as error:
        return str(error)
