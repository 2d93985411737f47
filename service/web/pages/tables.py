"""Tables of the pages as CSV."""

from typing import Annotated

from fastapi import APIRouter, Query, Response

from service import store
from service.store.tables import MeasurementRow
from service.twin.alarms.field_filter import HeliostatFilter, filter_heliostats
from service.twin.alarms.field_overview import PATIENCE_S
from service.twin.surfaces.accuracy import photograph_name
from service.web.api.field_overview import FieldLine, field_line
from service.web.auth.dependencies import READ, RENDER_SLOT, FieldCacheDep, NamePath, RuntimeDep
from service.web.responses.csv_tables import sheet_answer

router = APIRouter(include_in_schema=False, dependencies=[READ, RENDER_SLOT])

_FIELD = [name for name in FieldLine.model_fields if name not in ("position_m", "warnings")]


@router.get("/field.csv")
def get_field_table(
    filters: Annotated[HeliostatFilter, Query()], runtime: RuntimeDep, cache: FieldCacheDep
) -> Response:
    """All heliostats of the filter, in its order."""
    with runtime.database.reading() as session:
        lines = filter_heliostats(cache.read(session, PATIENCE_S).lines, filters)
    columns = ["east_m", "north_m", *_FIELD, "warnings"]
    summaries = map(field_line, lines)
    rows = (
        [*line.position_m, *(getattr(line, name) for name in _FIELD), "; ".join(line.warnings)]
        for line in summaries
    )
    return sheet_answer("field", columns, rows)


_QUALITY = (
    "signal_to_background",
    "signal_to_noise",
    "saturated_share",
    "cut_share",
    "second_spot_share",
    "energy_outside_window",
)
_PHOTOGRAPH = (
    "photograph",
    "id",
    "kind",
    "accepted",
    "reason",
    "detail",
    "taken_at",
    "target",
    "sun_azimuth_deg",
    "sun_elevation_deg",
    "motor_axis_1",
    "motor_axis_2",
    "center_right_m",
    "center_up_m",
    *_QUALITY,
    "created_at",
    "sent_by",
    "corrected_at",
    "image_sha256",
)


def _photograph(row: MeasurementRow) -> list[object]:
    return [
        photograph_name(row),
        row.identifier,
        row.kind,
        row.accepted,
        row.reason,
        row.quality.get("detail"),
        row.taken_at,
        row.target.name,
        row.sun_azimuth_deg,
        row.sun_elevation_deg,
        row.motor_axis_1,
        row.motor_axis_2,
        row.center_right_m,
        row.center_up_m,
        *(row.quality.get(name) for name in _QUALITY),
        row.created_at,
        row.sent_by,
        row.corrected_at,
        row.image_sha256,
    ]


@router.get("/heliostats/{name}/photographs.csv")
def get_photographs_table(name: NamePath, runtime: RuntimeDep) -> Response:
    """All images of a heliostat's photographs, in the order of their arrival."""
    with runtime.database.reading() as session:
        rows = store.list_measurements(session, store.get_heliostat(session, name), None)
    return sheet_answer(f"{name}-photographs", _PHOTOGRAPH, map(_photograph, rows))
