"""When each photograph was taken or else came, in a column and in order: a field's photographs by
pages.
"""

import sqlalchemy as sa
from alembic import op

revision = "0014"
down_revision = "0013"
branch_labels = None
depends_on = None


def upgrade() -> None:
    # PostgreSQL before 18 stores computed columns. SQLite can add only virtual ones to a table.
    is_stored = op.get_context().dialect.name == "postgresql"
    worked_out = sa.Computed("coalesce(taken_at, created_at)", persisted=is_stored)
    op.add_column(
        "measurements", sa.Column("moment", sa.DateTime(timezone=True), worked_out, nullable=True)
    )
    op.drop_index(op.f("ix_measurements_target_id"), "measurements")
    op.create_index(op.f("ix_measurements_moment_id"), "measurements", ["moment", "id"])
    op.create_index(
        op.f("ix_measurements_accepted_moment_id"), "measurements", ["accepted", "moment", "id"]
    )
    op.create_index(
        op.f("ix_measurements_target_id_moment_id"), "measurements", ["target_id", "moment", "id"]
    )
    op.create_index(
        op.f("ix_measurements_heliostat_id_external_id"),
        "measurements",
        ["heliostat_id", "external_id"],
    )


def downgrade() -> None:
    op.drop_index(op.f("ix_measurements_heliostat_id_external_id"), "measurements")
    op.drop_index(op.f("ix_measurements_target_id_moment_id"), "measurements")
    op.drop_index(op.f("ix_measurements_accepted_moment_id"), "measurements")
    op.drop_index(op.f("ix_measurements_moment_id"), "measurements")
    op.create_index(op.f("ix_measurements_target_id"), "measurements", ["target_id"])
    op.drop_column("measurements", "moment")
