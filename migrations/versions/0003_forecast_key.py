"""What a photograph's accuracy on arrival is based on, so that it need not be traced again."""

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("measurements", sa.Column("forecast_key", sa.String(200), nullable=True))


def downgrade() -> None:
    op.drop_column("measurements", "forecast_key")
