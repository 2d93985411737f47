"""Versions of the plant's model keep what was declared when they were made; one may come of another
declaration.
"""

import sqlalchemy as sa
from alembic import op

revision = "0006"
down_revision = "0005"
branch_labels = None
depends_on = None

_NEWEST = "FROM models WHERE withdrawn_at IS NULL ORDER BY number DESC LIMIT 1"


def upgrade() -> None:
    with op.batch_alter_table("models") as models:
        models.add_column(sa.Column("declared", sa.JSON(none_as_null=True), nullable=True))
        models.alter_column("study_id", existing_type=sa.Integer(), nullable=True)
    # Until now all versions shared what the plant declares.
    op.execute("UPDATE models SET declared = (SELECT declared FROM plant WHERE id = 1)")


def downgrade() -> None:
    # What is declared now stays declared; that of earlier versions, and those that came of it, go.
    op.execute(
        f"UPDATE plant SET declared = (SELECT declared {_NEWEST}) WHERE EXISTS (SELECT 1 {_NEWEST})"
    )
    op.execute("DELETE FROM models WHERE study_id IS NULL")
    with op.batch_alter_table("models") as models:
        models.alter_column("study_id", existing_type=sa.Integer(), nullable=False)
        models.drop_column("declared")
