"""Receivers: cylinders that a field's light falls on."""

import sqlalchemy as sa
from alembic import op

revision = "0005"
down_revision = "0004"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "receivers",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("name", sa.String(length=64), nullable=False),
        sa.Column("center_m", sa.JSON(none_as_null=True), nullable=False),
        sa.Column("normal", sa.JSON(none_as_null=True), nullable=False),
        sa.Column("up", sa.JSON(none_as_null=True), nullable=False),
        sa.Column("radius_m", sa.Double(), nullable=False),
        sa.Column("height_m", sa.Double(), nullable=False),
        sa.Column("opening_deg", sa.Double(), nullable=False),
        sa.Column("updated_at", sa.DateTime(timezone=True), nullable=False),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_receivers")),
        sa.UniqueConstraint("name", name=op.f("uq_receivers_name")),
    )


def downgrade() -> None:
    op.drop_table("receivers")
