"""Wind and temperature while photographs were taken."""

import sqlalchemy as sa
from alembic import op

revision = "0011"
down_revision = "0010"
branch_labels = None
depends_on = None

_COLUMNS = ("wind_speed_m_s", "wind_from_deg", "temperature_c")


def upgrade() -> None:
    for name in _COLUMNS:
        op.add_column("measurements", sa.Column(name, sa.Double(), nullable=True))


def downgrade() -> None:
    for name in _COLUMNS:
        op.drop_column("measurements", name)
