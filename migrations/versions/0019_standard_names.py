"""Columns, and keys in results of predictions, get standard names. The audit trail stays as it was
written.
"""

import sqlalchemy as sa
from alembic import op

revision = "0019"
down_revision = "0018"
branch_labels = None
depends_on = None

COLUMNS = (
    ("surfaces", "set_aside", "is_candidate"),
    ("surfaces", "doubts", "warnings"),
    ("surfaces", "doubted_since", "warned_since"),
    ("surfaces", "strangeness", "mahalanobis_distance"),
    ("surfaces", "seen_at", "acknowledged_at"),
    ("surfaces", "seen_by", "acknowledged_by"),
    ("surface_decisions", "taken", "became_active"),
    ("surface_decisions", "set_aside_before", "candidates_before"),
    ("acknowledgements", "mark", "fingerprint"),
    ("drift", "least_drop", "min_drop"),
)

_JOBS = sa.table("jobs", sa.column("id"), sa.column("kind"), sa.column("result", sa.JSON))
_STEPS = sa.table("job_steps", sa.column("job_id"), sa.column("name"), sa.column("result", sa.JSON))


def upgrade() -> None:
    for table, old, new in COLUMNS:
        op.execute(f"ALTER TABLE {table} RENAME COLUMN {old} TO {new}")
    _rename_in_predictions("taken", "became_active")


def downgrade() -> None:
    _rename_in_predictions("became_active", "taken")
    for table, old, new in COLUMNS:
        op.execute(f"ALTER TABLE {table} RENAME COLUMN {new} TO {old}")


def _rename_in_predictions(old: str, new: str) -> None:
    """Rename a key of the comparisons with the active surface, in jobs and their steps."""
    bind, is_prediction = op.get_bind(), _JOBS.c.kind == "predictions"
    jobs = sa.select(_JOBS.c.id, _JOBS.c.result).where(is_prediction)
    for number, result in bind.execute(jobs).all():
        if result and (judged := result.get("judged")):
            renamed = {name: _renamed(one, old, new) for name, one in judged.items()}
            changed = sa.update(_JOBS).where(_JOBS.c.id == number)
            bind.execute(changed.values(result=result | {"judged": renamed}))
    of_predictions = _STEPS.c.job_id.in_(sa.select(_JOBS.c.id).where(is_prediction))
    steps = sa.select(_STEPS.c.job_id, _STEPS.c.name, _STEPS.c.result).where(of_predictions)
    for number, name, result in bind.execute(steps).all():
        if result and (judged := result.get("judged")):
            changed = sa.update(_STEPS).where(_STEPS.c.job_id == number, _STEPS.c.name == name)
            bind.execute(changed.values(result=result | {"judged": _renamed(judged, old, new)}))


def _renamed(judged: dict[str, object], old: str, new: str) -> dict[str, object]:
    return {new if key == old else key: value for key, value in judged.items()}
