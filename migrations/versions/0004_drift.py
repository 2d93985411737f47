"""Drift: how well each heliostat's twin forecast its newest photograph."""

import sqlalchemy as sa
from alembic import op

revision = "0004"
down_revision = "0003"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "drift",
        sa.Column("heliostat_id", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("measurement_id", sa.Integer(), nullable=False),
        sa.Column("surface_id", sa.Integer(), nullable=False),
        sa.Column("taken_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("accuracy", sa.Double(), nullable=False),
        sa.ForeignKeyConstraint(
            ["heliostat_id"], ["heliostats.id"], name=op.f("fk_drift_heliostat_id_heliostats")
        ),
        sa.ForeignKeyConstraint(
            ["measurement_id"],
            ["measurements.id"],
            name=op.f("fk_drift_measurement_id_measurements"),
        ),
        sa.ForeignKeyConstraint(
            ["surface_id"], ["surfaces.id"], name=op.f("fk_drift_surface_id_surfaces")
        ),
        sa.PrimaryKeyConstraint("heliostat_id", name=op.f("pk_drift")),
    )


def downgrade() -> None:
    op.drop_table("drift")
