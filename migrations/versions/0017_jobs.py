"""Jobs: phases, turns by key, short ones, attempts since progress; maps of plans one by one;
warnings of forecasts.
"""

import io

import numpy as np
import sqlalchemy as sa
from alembic import op

revision = "0017"
down_revision = "0016"
branch_labels = None
depends_on = None

_NEW: tuple[sa.Column[object], ...] = (
    sa.Column("attempted_at", sa.DateTime(timezone=True), nullable=True),
    sa.Column("attempts_before_progress", sa.Integer(), nullable=False, server_default="0"),
    sa.Column("is_short", sa.Boolean(), nullable=False, server_default=sa.false()),
    sa.Column("phase", sa.String(100), nullable=False, server_default=sa.text("''")),
    sa.Column("n_done", sa.Integer(), nullable=True),
    sa.Column("n_total", sa.Integer(), nullable=True),
    sa.Column("remaining_s", sa.Double(), nullable=True),
)
_JOBS = sa.table(
    "jobs", sa.column("id"), sa.column("kind"), sa.column("state"), sa.column("arrays")
)
_STEPS = sa.table(
    "job_steps",
    sa.column("job_id"),
    sa.column("name"),
    sa.column("result", sa.JSON()),
    sa.column("arrays"),
)


def upgrade() -> None:
    for column in _NEW:
        op.add_column("jobs", column)
    op.create_index(op.f("ix_jobs_created_by_attempted_at"), "jobs", ["created_by", "attempted_at"])
    op.add_column("job_steps", sa.Column("arrays", sa.LargeBinary(), nullable=True))
    op.add_column("forecasts", sa.Column("warnings", sa.JSON(none_as_null=True), nullable=True))
    for number in _plans():
        _split(number)


def downgrade() -> None:
    for number in _plans():
        _join(number)
    op.drop_column("forecasts", "warnings")
    op.drop_column("job_steps", "arrays")
    op.drop_index(op.f("ix_jobs_created_by_attempted_at"), "jobs")
    for column in _NEW:
        op.drop_column("jobs", column.name)


def _plans() -> list[int]:
    query = sa.select(_JOBS.c.id).where(
        _JOBS.c.kind == "plans", _JOBS.c.state == "done", _JOBS.c.arrays.is_not(None)
    )
    return list(op.get_bind().scalars(query))


def _split(number: int) -> None:
    """Each time's maps become a part of the plan's job, named by its index."""
    arrays = _arrays(number)
    twin, ideal = arrays.pop("twin"), arrays.pop("ideal")
    for index in range(len(twin)):
        maps = _packed({"twin": twin[index], "ideal": ideal[index]})
        row = {"job_id": number, "name": f"{index:03d}", "result": {}, "arrays": maps}
        op.get_bind().execute(sa.insert(_STEPS).values(row))
    _write(number, arrays)


def _join(number: int) -> None:
    """The maps of all times in one array each, as older versions read them."""
    of_plan = (_STEPS.c.job_id == number) & _STEPS.c.arrays.is_not(None)
    found = op.get_bind().scalars(sa.select(_STEPS.c.arrays).where(of_plan).order_by(_STEPS.c.name))
    maps = [_unpacked(data) for data in found]
    stacked = {name: np.array([of_time[name] for of_time in maps]) for name in ("twin", "ideal")}
    _write(number, _arrays(number) | stacked)
    op.get_bind().execute(sa.delete(_STEPS).where(_STEPS.c.job_id == number))


def _arrays(number: int) -> dict[str, np.ndarray]:
    return _unpacked(op.get_bind().scalar(sa.select(_JOBS.c.arrays).where(_JOBS.c.id == number)))


def _write(number: int, arrays: dict[str, np.ndarray]) -> None:
    op.get_bind().execute(
        sa.update(_JOBS).where(_JOBS.c.id == number).values(arrays=_packed(arrays))
    )


def _unpacked(data: bytes) -> dict[str, np.ndarray]:
    with np.load(io.BytesIO(data), allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files}


def _packed(arrays: dict[str, np.ndarray]) -> bytes:
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    return buffer.getvalue()
