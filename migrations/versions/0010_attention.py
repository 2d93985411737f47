"""What needs attention and was acknowledged; since when a heliostat's forecasts are poor."""

import sqlalchemy as sa
from alembic import op

revision = "0010"
down_revision = "0009"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "acknowledgements",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("heliostat_id", sa.Integer(), nullable=True),
        sa.Column("reason", sa.String(32), nullable=False),
        sa.Column("mark", sa.String(96), nullable=False),
        sa.Column("made_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("made_by", sa.String(64), nullable=False),
        sa.ForeignKeyConstraint(
            ["heliostat_id"],
            ["heliostats.id"],
            name=op.f("fk_acknowledgements_heliostat_id_heliostats"),
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_acknowledgements")),
    )
    op.create_index(op.f("ix_acknowledgements_heliostat_id"), "acknowledgements", ["heliostat_id"])
    op.add_column("drift", sa.Column("poor_since", sa.DateTime(timezone=True), nullable=True))


def downgrade() -> None:
    op.drop_column("drift", "poor_since")
    op.drop_table("acknowledgements")
