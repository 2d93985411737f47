"""History of alarms; acknowledgements of several alarms at once, with a reason, and undone.

An older version knows no undone acknowledgement: on the way down these are deleted.
"""

import sqlalchemy as sa
from alembic import op

revision = "0025"
down_revision = "0024"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("acknowledgements", sa.Column("batch", sa.Integer(), nullable=True))
    op.add_column(
        "acknowledgements", sa.Column("comment", sa.String(200), nullable=False, server_default="")
    )
    op.add_column(
        "acknowledgements", sa.Column("undone_at", sa.DateTime(timezone=True), nullable=True)
    )
    op.add_column("acknowledgements", sa.Column("undone_by", sa.String(64), nullable=True))
    op.create_index(op.f("ix_acknowledgements_batch"), "acknowledgements", ["batch"])
    op.execute("UPDATE acknowledgements SET batch = id")
    op.create_table(
        "alarms",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("heliostat_id", sa.Integer(), nullable=True),
        sa.Column("reason", sa.String(32), nullable=False),
        sa.Column("fingerprint", sa.String(96), nullable=False),
        sa.Column("message", sa.Text(), nullable=False),
        sa.Column("since", sa.DateTime(timezone=True), nullable=False),
        sa.Column("opened_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("closed_at", sa.DateTime(timezone=True), nullable=True),
        sa.ForeignKeyConstraint(
            ["heliostat_id"], ["heliostats.id"], name=op.f("fk_alarms_heliostat_id_heliostats")
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_alarms")),
    )
    op.create_index(op.f("ix_alarms_heliostat_id"), "alarms", ["heliostat_id"])
    op.create_index(op.f("ix_alarms_closed_at"), "alarms", ["closed_at"])


def downgrade() -> None:
    op.drop_table("alarms")
    op.execute("DELETE FROM acknowledgements WHERE undone_at IS NOT NULL")
    op.drop_index(op.f("ix_acknowledgements_batch"), "acknowledgements")
    for name in ("undone_by", "undone_at", "comment", "batch"):
        op.drop_column("acknowledgements", name)
