"""Forecasts keep the time that they were asked for."""

import sqlalchemy as sa
from alembic import op

revision = "0009"
down_revision = "0007"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("forecasts", sa.Column("sun_at", sa.DateTime(timezone=True), nullable=True))


def downgrade() -> None:
    op.drop_column("forecasts", "sun_at")
