"""Forecasts of one heliostat: what becomes of each watt; unknown for those before."""

import sqlalchemy as sa
from alembic import op

revision = "0023"
down_revision = "0022"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("forecasts", sa.Column("losses", sa.JSON(none_as_null=True), nullable=True))


def downgrade() -> None:
    op.drop_column("forecasts", "losses")
