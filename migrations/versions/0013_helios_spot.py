"""Where HeliOS found the spot, beside UTIS."""

import sqlalchemy as sa
from alembic import op

revision = "0013"
down_revision = "0012"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("measurements", sa.Column("helios_spot_wgs84", sa.JSON(), nullable=True))


def downgrade() -> None:
    op.drop_column("measurements", "helios_spot_wgs84")
