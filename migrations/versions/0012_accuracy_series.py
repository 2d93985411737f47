"""How each photograph was forecast when it came, and whether a heliostat's accuracy fell."""

import sqlalchemy as sa
from alembic import op

revision = "0012"
down_revision = "0011"
branch_labels = None
depends_on = None

_FALL: tuple[sa.Column[object], ...] = (
    sa.Column("recent", sa.Double(), nullable=True),
    sa.Column("earlier", sa.Double(), nullable=True),
    sa.Column("least_drop", sa.Double(), nullable=True),
    sa.Column("fell_since", sa.DateTime(timezone=True), nullable=True),
)


def upgrade() -> None:
    op.add_column("measurements", sa.Column("forecast_accuracy", sa.Double(), nullable=True))
    for column in _FALL:
        op.add_column("drift", column)


def downgrade() -> None:
    for column in _FALL:
        op.drop_column("drift", column.name)
    op.drop_column("measurements", "forecast_accuracy")
