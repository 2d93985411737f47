"""What the service keeps: tables, queries by resource, the queue, images, back-up.

`from service import store` has the queries: functions on a SQLAlchemy session, each doing one thing.
"""

from service.store.measurements import (
    add_measurement,
    find_measurement_of_image,
    get_measurement,
    list_measurements,
    recent_measurements,
)
from service.store.models import put_declared
from service.store.plant import (
    add_heliostat,
    find_heliostat,
    find_receiver,
    get_heliostat,
    get_heliostats,
    get_plant,
    get_receiver,
    get_target,
    get_target_or_receiver,
    list_heliostats,
    list_receivers,
    list_targets,
    put_heliostat,
    put_plant,
    put_receiver,
    put_target,
    require_same_properties,
    target_plane,
)
from service.store.removal import remove_heliostat, remove_receiver, remove_target
from service.store.results import add_forecast, add_study, counts, get_forecast, get_study, list_forecasts, list_studies
from service.store.rows import Change, insert, one_at_a_time
from service.store.surfaces import (
    NewSurface,
    add_surface,
    current_surfaces,
    find_measured_surface,
    find_surface_at,
    get_surface,
    get_surface_at,
    list_surfaces,
)

__all__ = [
    "Change",
    "NewSurface",
    "add_forecast",
    "add_heliostat",
    "add_measurement",
    "add_study",
    "add_surface",
    "counts",
    "current_surfaces",
    "find_heliostat",
    "find_measured_surface",
    "find_measurement_of_image",
    "find_receiver",
    "find_surface_at",
    "get_forecast",
    "get_heliostat",
    "get_heliostats",
    "get_measurement",
    "get_plant",
    "get_receiver",
    "get_study",
    "get_surface",
    "get_surface_at",
    "get_target",
    "get_target_or_receiver",
    "insert",
    "list_forecasts",
    "list_heliostats",
    "list_measurements",
    "list_receivers",
    "list_studies",
    "list_surfaces",
    "list_targets",
    "one_at_a_time",
    "put_declared",
    "put_heliostat",
    "put_plant",
    "put_receiver",
    "put_target",
    "recent_measurements",
    "remove_heliostat",
    "remove_receiver",
    "remove_target",
    "require_same_properties",
    "target_plane",
]
