"""One photograph is one measurement: other identifiers of it, forced ones, and what deleted ones
leave.
"""

import sqlalchemy as sa
from alembic import op

revision = "0018"
down_revision = "0017"
branch_labels = None
depends_on = None

_KNOWN_BEFORE = (
    "SELECT 1 FROM measurements AS other WHERE other.image_sha256 = measurements.image_sha256 "
    "AND other.heliostat_id <> measurements.heliostat_id AND other.id < measurements.id"
)


def upgrade() -> None:
    op.create_table(
        "measurement_aliases",
        sa.Column("heliostat_id", sa.Integer(), nullable=False),
        sa.Column("identifier", sa.String(96), nullable=False),
        sa.Column("measurement_id", sa.Integer(), nullable=False),
        sa.ForeignKeyConstraint(
            ["heliostat_id"],
            ["heliostats.id"],
            name=op.f("fk_measurement_aliases_heliostat_id_heliostats"),
        ),
        sa.ForeignKeyConstraint(
            ["measurement_id"],
            ["measurements.id"],
            name=op.f("fk_measurement_aliases_measurement_id_measurements"),
        ),
        sa.PrimaryKeyConstraint("heliostat_id", "identifier", name=op.f("pk_measurement_aliases")),
    )
    op.create_index(
        op.f("ix_measurement_aliases_measurement_id"), "measurement_aliases", ["measurement_id"]
    )
    op.add_column(
        "heliostats", sa.Column("photographs_changed_at", sa.DateTime(timezone=True), nullable=True)
    )
    op.add_column("measurements", sa.Column("forced", sa.Text(), nullable=True))
    op.add_column("surfaces", sa.Column("deleted", sa.JSON(), nullable=True))
    # Stores from before this rule keep what they hold; an import of their export must not drop it.
    op.execute(
        "UPDATE measurements SET forced = 'stored before images were compared' WHERE EXISTS"
        f" ({_KNOWN_BEFORE})"
    )


def downgrade() -> None:
    op.drop_column("surfaces", "deleted")
    op.drop_column("measurements", "forced")
    op.drop_column("heliostats", "photographs_changed_at")
    op.drop_index(op.f("ix_measurement_aliases_measurement_id"), "measurement_aliases")
    op.drop_table("measurement_aliases")
