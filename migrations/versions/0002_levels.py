"""Levels of the field's accuracy, to distinguish its falls from those of one heliostat."""

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("field_state", sa.Column("levels", sa.JSON(), nullable=True))


def downgrade() -> None:
    op.drop_column("field_state", "levels")
