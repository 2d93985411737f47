"""Neighbours of a photographed heliostat, as the stored layout has them in operation.

A heliostat of the layout aims at its receiver while another one is photographed. Without a stored
receiver it is not known where neighbours aim, and a photograph has none.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from sqlalchemy.orm import Session

from model.fleet import aligned_field
from model.plant import Heliostat
from model.plant_model import PlantModel
from model.study import FluxImage
from service import store
from service.base.errors import SKIPPED
from service.store import mounts
from service.twin.measurements import HeliostatContext
from service.twin.stored_mount import as_calibrated

Array = NDArray[np.float64]

# How far neighbours are looked for, in diagonals of the mirror: a mirror as high as this one hides
# it from suns above five degrees up to that distance.
_REACH = 12


class Neighbour(NamedTuple):
    """A heliostat near another one, and the point (3,) [m] that it aims at in operation."""

    heliostat: Heliostat
    aim: Array


def load_neighbours(session: Session, twin: HeliostatContext) -> list[Neighbour]:
    """Stored heliostats near one, with their aims; none if no receiver is stored."""
    receivers = {row.name: store.stored_receiver(row) for row in store.list_receivers(session)}
    if not receivers:
        return []
    reach = _REACH * float(np.hypot(twin.heliostat.width, twin.heliostat.height))
    rows = store.list_heliostats_near(session, twin.row, reach)
    given = store.receivers_of_heliostats(session)
    calibrated = {
        row.name: mount for row, mount in mounts.current_mounts(session, [row.name for row in rows])
    }
    found = []
    for row in rows:
        try:
            heliostat = as_calibrated(row, calibrated.get(row.name), twin.model)
        except SKIPPED:  # it cannot be placed; forecasts of the field name it
            continue
        receiver = receivers.get(given.get(row.name, ""), next(iter(receivers.values())))
        found.append(Neighbour(heliostat, receiver.aim_of(heliostat.position)))
    return found


def with_neighbours(
    photograph: FluxImage, neighbours: Sequence[Neighbour], model: PlantModel
) -> FluxImage:
    """Add the mirrors that may have hidden parts of the photographed one."""
    if not neighbours:
        return photograph
    setup = photograph.setup
    field = aligned_field([(setup.heliostat, setup.goal), *neighbours], setup.sun, model)
    rectangles = field.obstacles([setup.heliostat.name])[0]
    return replace(photograph, setup=replace(setup, neighbours=rectangles))
