"""Images bear their verdict and whether they were pruned; totals say how many the store keeps, and
of what size.
"""

import sqlalchemy as sa
from alembic import op

revision = "0007"
down_revision = "0006"
branch_labels = None
depends_on = None

_INDEX = "ix_images_pruned_at_accepted_created_at"
_ACCEPTED = (
    "SELECT 1 FROM measurements WHERE image_sha256 = images.sha256 AND measurements.accepted"
)


def upgrade() -> None:
    # Column by column: measurements refer to the table, so SQLite could not drop and recreate it.
    op.add_column(
        "images", sa.Column("accepted", sa.Boolean(), server_default=sa.false(), nullable=False)
    )
    op.add_column("images", sa.Column("pruned_at", sa.DateTime(timezone=True), nullable=True))
    op.add_column("images", sa.Column("pruned_for", sa.String(8), nullable=True))
    op.add_column("images", sa.Column("removed_at", sa.DateTime(timezone=True), nullable=True))
    op.execute(f"UPDATE images SET accepted = EXISTS ({_ACCEPTED})")
    op.create_index(op.f(_INDEX), "images", ["pruned_at", "accepted", "created_at"])
    op.create_table(
        "image_totals",
        sa.Column("accepted", sa.Boolean(), nullable=False),
        sa.Column("images", sa.Integer(), nullable=False),
        sa.Column("size_bytes", sa.BigInteger(), nullable=False),
        sa.PrimaryKeyConstraint("accepted", name=op.f("pk_image_totals")),
    )
    op.execute(
        "INSERT INTO image_totals (accepted, images, size_bytes) "
        "SELECT accepted, count(*), sum(size_bytes) FROM images GROUP BY accepted"
    )


def downgrade() -> None:
    # Rows of pruned images stay, and older versions call their files lost.
    op.drop_table("image_totals")
    op.drop_index(op.f(_INDEX), "images")
    for column in ("removed_at", "pruned_for", "pruned_at", "accepted"):
        op.drop_column("images", column)
