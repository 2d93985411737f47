"""Receivers of every kind, and what plant.yaml says of tower, time zone and heliostat types.

Older versions know cylinders that absorb all light: on the way down receivers of other kinds are
deleted, and absorptances too.
"""

import sqlalchemy as sa
from alembic import op

revision = "0021"
down_revision = "0020"
branch_labels = None
depends_on = None

_ONLY_CYLINDERS = ("radius_m", "opening_deg")


def upgrade() -> None:
    with op.batch_alter_table("receivers") as receivers:
        receivers.add_column(
            sa.Column("kind", sa.String(length=16), nullable=False, server_default="cylinder")
        )
        receivers.add_column(
            sa.Column("absorptance", sa.Double(), nullable=False, server_default="1")
        )
        receivers.add_column(sa.Column("width_m", sa.Double(), nullable=True))
        receivers.add_column(sa.Column("panels", sa.JSON(none_as_null=True), nullable=True))
        receivers.add_column(sa.Column("aperture_m", sa.JSON(none_as_null=True), nullable=True))
        for name in _ONLY_CYLINDERS:
            receivers.alter_column(name, existing_type=sa.Double(), nullable=True)
    with op.batch_alter_table("plant") as plant:
        plant.add_column(sa.Column("tower", sa.JSON(none_as_null=True), nullable=True))
        plant.add_column(sa.Column("time_zone", sa.String(length=64), nullable=True))
        plant.add_column(sa.Column("heliostat_types", sa.JSON(none_as_null=True), nullable=True))


def downgrade() -> None:
    op.execute("DELETE FROM receivers WHERE kind <> 'cylinder'")
    with op.batch_alter_table("plant") as plant:
        for name in ("heliostat_types", "time_zone", "tower"):
            plant.drop_column(name)
    with op.batch_alter_table("receivers") as receivers:
        for name in _ONLY_CYLINDERS:
            receivers.alter_column(name, existing_type=sa.Double(), nullable=False)
        for name in ("aperture_m", "panels", "width_m", "absorptance", "kind"):
            receivers.drop_column(name)
