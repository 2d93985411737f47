"""Reasons of adopted and withdrawn versions of the model; unknown for those before."""

import sqlalchemy as sa
from alembic import op

revision = "0024"
down_revision = "0023"
branch_labels = None
depends_on = None


def upgrade() -> None:
    for name in ("reason", "withdrawn_reason"):
        op.add_column("models", sa.Column(name, sa.String(200), nullable=True))


def downgrade() -> None:
    for name in ("reason", "withdrawn_reason"):
        op.drop_column("models", name)
