"""Azimuths count from north over east; before, they counted from south, positive to the east.

Columns of times have one name. Corrections name their fields by the paths of REST, and have times
with Z. The details of audit entries stay as they were written.
"""

from collections.abc import Callable, Sequence
from typing import Any

import sqlalchemy as sa
from alembic import op

revision = "0020"
down_revision = "0019"
branch_labels = None
depends_on = None

_BATCH = 10_000

COLUMNS = (
    ("corrections", "made_at", "created_at"),
    ("corrections", "made_by", "created_by"),
    ("surface_decisions", "made_at", "created_at"),
    ("surface_decisions", "made_by", "created_by"),
    ("studies", "taken_from", "first_taken_at"),
    ("studies", "taken_to", "last_taken_at"),
    ("audit", "at", "created_at"),
)

_ZONES = ("+00:00", "Z")

_ASKED = {
    "begin": "first_at",
    "end": "last_at",
    "aim_point": "aim_point_m",
    "aim_points": "aim_points_m",
    "aim_offsets": "aim_offsets_m",
}
"""Fields of forecasts and plans of the field."""

_FIELDS = {
    "focal_spot": "focal_spot_wgs84",
    "helios_spot": "helios_spot_wgs84",
    "target_name": "target",
    "sun_azimuth": "sun.azimuth_deg",
    "sun_elevation": "sun.elevation_deg",
}
"""Fields of corrections, before and after."""

_CORRECTIONS = sa.table(
    "corrections", sa.column("id"), sa.column("before", sa.JSON), sa.column("after", sa.JSON)
)
_JOBS = sa.table(
    "jobs",
    sa.column("id"),
    sa.column("kind"),
    sa.column("payload", sa.JSON),
    sa.column("result", sa.JSON),
)
_STEPS = sa.table("job_steps", sa.column("job_id"), sa.column("name"), sa.column("result", sa.JSON))


def upgrade() -> None:
    for table, old, new in COLUMNS:
        op.execute(f"ALTER TABLE {table} RENAME COLUMN {old} TO {new}")
    _turn_columns(_from_north)
    _change_corrections(_FIELDS, _from_north, _ZONES)
    _change_jobs(_ASKED, _from_north)
    _rename_action("surface.seen", "surface.acknowledged")


def downgrade() -> None:
    _rename_action("surface.acknowledged", "surface.seen")
    _change_jobs({new: old for old, new in _ASKED.items()}, _from_south)
    _change_corrections({new: old for old, new in _FIELDS.items()}, _from_south, _ZONES[::-1])
    _turn_columns(_from_south)
    for table, old, new in COLUMNS:
        op.execute(f"ALTER TABLE {table} RENAME COLUMN {new} TO {old}")


def _rename_action(old: str, new: str) -> None:
    """Rename an action of the audit trail."""
    audit = sa.table("audit", sa.column("action"))
    op.execute(sa.update(audit).where(audit.c.action == old).values(action=new))


def _from_north(degrees: float) -> float:
    return round(180 - degrees, 12) % 360


def _from_south(degrees: float) -> float:
    return round(180 - degrees, 12)


def _turn_columns(turn: Callable[[float], float]) -> None:
    """Convert azimuths as the service converts those that it reads, to the last bit."""
    bind = op.get_bind()
    for name in ("measurements", "forecasts"):
        table = sa.table(name, sa.column("id"), sa.column("sun_azimuth_deg"))
        change = (
            sa.update(table)
            .where(table.c.id == sa.bindparam("number"))
            .values(sun_azimuth_deg=sa.bindparam("azimuth"))
        )
        last = 0
        while True:
            rows = bind.execute(
                sa.select(table.c.id, table.c.sun_azimuth_deg)
                .where(table.c.id > last)
                .order_by(table.c.id)
                .limit(_BATCH)
            ).all()
            if not rows:
                break
            bind.execute(
                change, [{"number": number, "azimuth": turn(azimuth)} for number, azimuth in rows]
            )
            last = rows[-1][0]


def _change_corrections(
    names: dict[str, str], turn: Callable[[float], float], zones: Sequence[str]
) -> None:
    bind = op.get_bind()
    for number, before, after in bind.execute(sa.select(*_CORRECTIONS.c)).all():
        changed = {
            "before": _renamed(before, names, turn, zones),
            "after": _renamed(after, names, turn, zones),
        }
        if changed != {"before": before, "after": after}:
            bind.execute(
                sa.update(_CORRECTIONS).where(_CORRECTIONS.c.id == number).values(**changed)
            )


def _renamed(
    fields: dict[str, Any],
    names: dict[str, str],
    turn: Callable[[float], float],
    zones: Sequence[str],
) -> dict[str, Any]:
    renamed = {}
    for name, value in fields.items():
        if name in names and "azimuth" in name:
            value = turn(value)
        elif name == "taken_at" and value is not None:
            value = value.replace(*zones)
        renamed[names.get(name, name)] = value
    return renamed


def _change_jobs(names: dict[str, str], turn: Callable[[float], float]) -> None:
    """Convert the suns of forecasts and plans of the field, in what was asked and found.

    What was asked gets other names.
    """
    bind, is_forecast = op.get_bind(), _JOBS.c.kind.in_(("forecasts", "plans"))
    for number, _, payload, result in bind.execute(sa.select(*_JOBS.c).where(is_forecast)).all():
        asked = {names.get(name, name): value for name, value in payload.items()}
        changed = {"payload": _turned(asked, turn), "result": _numbered(_turned(result, turn))}
        if changed["result"] is None:
            del changed["result"]
        bind.execute(sa.update(_JOBS).where(_JOBS.c.id == number).values(**changed))
    of_forecasts = _STEPS.c.job_id.in_(sa.select(_JOBS.c.id).where(is_forecast))
    for number, name, result in bind.execute(sa.select(*_STEPS.c).where(of_forecasts)).all():
        if result is not None:
            bind.execute(
                sa.update(_STEPS)
                .where(_STEPS.c.job_id == number, _STEPS.c.name == name)
                .values(result=_turned(result, turn))
            )


def _numbered(result: Any) -> Any:
    """A result with the version of the model as a number; its effects are those of the model."""
    if isinstance(result, dict) and isinstance(version := result.get("model_version"), str):
        return result | {"model_version": int(version.partition(":")[0])}
    return result


def _turned(document: Any, turn: Callable[[float], float]) -> Any:
    """A document with its suns converted, at any level."""
    if isinstance(document, list):
        return [_turned(entry, turn) for entry in document]
    if not isinstance(document, dict):
        return document
    turned = {name: _turned(value, turn) for name, value in document.items()}
    sun = document.get("sun")
    if isinstance(sun, dict) and "azimuth_deg" in sun:
        turned["sun"] = sun | {"azimuth_deg": turn(sun["azimuth_deg"])}
    return turned
