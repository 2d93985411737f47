"""The tables of the pages as CSV."""

from dataclasses import fields
from typing import Annotated

from fastapi import APIRouter, Query, Response

from service import store
from service.store.tables import MeasurementRow
from service.twin.accuracy import name_of
from service.twin.attention import Item, needs_attention
from service.twin.field import PATIENCE_S, figures_of
from service.twin.finding import METRICS, Wanted, find
from service.web.answers.sheets import sheet_answer
from service.web.api.field import FieldLine, field_line
from service.web.door.dependencies import DRAWS, READ, FieldBookDep, NamePath, RuntimeDep

router = APIRouter(include_in_schema=False, dependencies=[READ, DRAWS])

_FIELD = [name for name in FieldLine.model_fields if name not in ("position_m", "doubts")]
_UNITS = {name: f"{name} [{metric.unit}]" for name, metric in METRICS.items()}


@router.get("/field.csv")
def get_field_table(wanted: Annotated[Wanted, Query()], runtime: RuntimeDep, book: FieldBookDep) -> Response:
    """All heliostats that are looked for, in their order."""
    with runtime.database.reading() as session:
        lines = find(book.read(session, PATIENCE_S).lines, wanted)
    columns = ["east [m]", "north [m]", *(_UNITS.get(name, name) for name in _FIELD), "doubts"]
    told = map(field_line, lines)
    rows = ([*line.position_m, *(getattr(line, name) for name in _FIELD), "; ".join(line.doubts)] for line in told)
    return sheet_answer("field", columns, rows)


@router.get("/attention.csv")
def get_attention_table(runtime: RuntimeDep, book: FieldBookDep) -> Response:
    """All that needs attention, acknowledged or not."""
    with runtime.database.reading() as session:
        items, _ = needs_attention(session, book, runtime.settings)
    columns = [one.name for one in fields(Item) if one.name != "mark"]
    return sheet_answer("attention", columns, ([getattr(item, name) for name in columns] for item in items))


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
    "sun_azimuth [deg]",
    "sun_elevation [deg]",
    "motor_1 [steps]",
    "motor_2 [steps]",
    "center_right [m]",
    "center_up [m]",
    *_QUALITY,
    "created_at",
    "corrected_at",
    "image_sha256",
)


def _photograph(row: MeasurementRow) -> list[object]:
    return [
        name_of(row),
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
        row.corrected_at,
        row.image_sha256,
    ]


@router.get("/heliostats/{name}/photographs.csv")
def get_photographs_table(name: NamePath, runtime: RuntimeDep) -> Response:
    """All images of a heliostat's photographs, in the order they came."""
    with runtime.database.reading() as session:
        rows = store.list_measurements(session, store.get_heliostat(session, name), None)
    return sheet_answer(f"{name}-photographs", _PHOTOGRAPH, map(_photograph, rows))


_SURFACE = (
    "version",
    "source",
    "is_todays",
    "set_aside",
    "valid_from",
    "created_at",
    "deviation [mm]",
    "uncertainty [mm]",
    "misfit [%]",
    "trusted",
    "doubts",
    "photographs",
    "model",
    "model_version",
)


@router.get("/heliostats/{name}/surfaces.csv")
def get_surfaces_table(name: NamePath, runtime: RuntimeDep) -> Response:
    """All versions of a heliostat's surface, oldest first."""
    with runtime.database.reading() as session:
        heliostat = store.get_heliostat(session, name)
        today = store.find_surface_at(session, heliostat)
        rows = store.list_surfaces(session, heliostat, None, arrays=True)
    lines = []
    for row in rows:
        figures = figures_of(row.arrays)
        lines.append(
            [
                row.version,
                row.source,
                today is not None and row.id == today.id,
                row.set_aside,
                None if row.valid_from.year <= 1970 else row.valid_from,
                row.created_at,
                figures.deviation_mm,
                figures.uncertainty_mm,
                None if row.misfit is None else 100 * row.misfit,
                row.trusted,
                "; ".join(row.doubts or []),
                " ".join(one.identifier for one in row.measurements),
                row.model,
                row.model_version,
            ]
        )
    return sheet_answer(f"{name}-surfaces", _SURFACE, lines)
