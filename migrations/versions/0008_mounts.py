"""Mounts calibrated by motors and spots; forecasts from motor positions."""

import sqlalchemy as sa
from alembic import op

revision = "0008"
down_revision = "0007"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "mounts",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("heliostat_id", sa.Integer(), nullable=False),
        sa.Column("version", sa.Integer(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("valid_from", sa.DateTime(timezone=True), nullable=False),
        sa.Column("document", sa.JSON(none_as_null=True), nullable=False),
        sa.ForeignKeyConstraint(
            ["heliostat_id"], ["heliostats.id"], name=op.f("fk_mounts_heliostat_id_heliostats")
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_mounts")),
        sa.UniqueConstraint("heliostat_id", "version", name=op.f("uq_mounts_heliostat_id_version")),
    )
    op.create_index(
        op.f("ix_mounts_heliostat_id_valid_from"), "mounts", ["heliostat_id", "valid_from"]
    )
    op.add_column(
        "forecasts", sa.Column("motor_position", sa.JSON(none_as_null=True), nullable=True)
    )


def downgrade() -> None:
    op.drop_column("forecasts", "motor_position")
    op.drop_index(op.f("ix_mounts_heliostat_id_valid_from"), "mounts")
    op.drop_table("mounts")
