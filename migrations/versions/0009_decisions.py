"""Store trust in surfaces, decisions on the active one, corrections, and times of forecasts."""

import sqlalchemy as sa
from alembic import op

revision = "0009"
down_revision = "0008"
branch_labels = None
depends_on = None


_TRUST: tuple[sa.Column[object], ...] = (
    sa.Column("trusted", sa.Boolean(), nullable=True),
    sa.Column("doubts", sa.JSON(none_as_null=True), nullable=True),
    sa.Column("doubted_since", sa.DateTime(timezone=True), nullable=True),
    sa.Column("suspicious", sa.JSON(none_as_null=True), nullable=True),
    sa.Column("strangeness", sa.Double(), nullable=True),
    sa.Column("sun_span_deg", sa.Double(), nullable=True),
    sa.Column("seen_at", sa.DateTime(timezone=True), nullable=True),
    sa.Column("seen_by", sa.String(64), nullable=True),
)


def upgrade() -> None:
    op.add_column("forecasts", sa.Column("sun_at", sa.DateTime(timezone=True), nullable=True))
    op.add_column(
        "surfaces", sa.Column("set_aside", sa.Boolean(), server_default=sa.false(), nullable=False)
    )
    for column in _TRUST:
        op.add_column("surfaces", column)
    op.create_table(
        "surface_decisions",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("heliostat_id", sa.Integer(), nullable=False),
        sa.Column("surface_id", sa.Integer(), nullable=False),
        sa.Column("previous", sa.Integer(), nullable=True),
        sa.Column("taken", sa.Boolean(), nullable=False),
        sa.Column("made_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("made_by", sa.String(64), nullable=False),
        sa.Column("reason", sa.String(200), nullable=False),
        sa.Column("accuracy_before", sa.Double(), nullable=True),
        sa.Column("accuracy_after", sa.Double(), nullable=True),
        sa.Column("photographs", sa.Integer(), nullable=False),
        sa.Column("set_aside_before", sa.JSON(none_as_null=True), nullable=False),
        sa.ForeignKeyConstraint(
            ["heliostat_id"],
            ["heliostats.id"],
            name=op.f("fk_surface_decisions_heliostat_id_heliostats"),
        ),
        sa.ForeignKeyConstraint(
            ["surface_id"], ["surfaces.id"], name=op.f("fk_surface_decisions_surface_id_surfaces")
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_surface_decisions")),
    )
    op.create_index(
        op.f("ix_surface_decisions_heliostat_id"), "surface_decisions", ["heliostat_id"]
    )
    op.add_column(
        "measurements", sa.Column("corrected_at", sa.DateTime(timezone=True), nullable=True)
    )
    op.create_table(
        "corrections",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("measurement_id", sa.Integer(), nullable=False),
        sa.Column("made_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("made_by", sa.String(64), nullable=False),
        sa.Column("reason", sa.String(200), nullable=False),
        sa.Column("before", sa.JSON(none_as_null=True), nullable=False),
        sa.Column("after", sa.JSON(none_as_null=True), nullable=False),
        sa.ForeignKeyConstraint(
            ["measurement_id"],
            ["measurements.id"],
            name=op.f("fk_corrections_measurement_id_measurements"),
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_corrections")),
    )
    op.create_index(op.f("ix_corrections_measurement_id"), "corrections", ["measurement_id"])


def downgrade() -> None:
    # Older versions know no candidates: there the newest surface is active again.
    op.drop_table("surface_decisions")
    op.drop_table("corrections")
    op.drop_column("measurements", "corrected_at")
    for column in (*(column.name for column in _TRUST), "set_aside"):
        op.drop_column("surfaces", column)
    op.drop_column("forecasts", "sun_at")
