"""Studies, the declared model and the versions that came after it, and the version that each
surface was made by.
"""

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "studies",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("created_by", sa.String(length=64), nullable=False),
        sa.Column("options", sa.JSON(none_as_null=True), nullable=False),
        sa.Column("heliostats", sa.JSON(none_as_null=True), nullable=False),
        sa.Column("taken_from", sa.DateTime(timezone=True), nullable=True),
        sa.Column("taken_to", sa.DateTime(timezone=True), nullable=True),
        sa.Column("model", sa.Integer(), nullable=False),
        sa.Column("model_version", sa.String(length=256), nullable=False),
        sa.Column("verdict", sa.String(length=16), nullable=False),
        sa.Column("conclusion", sa.Text(), nullable=False),
        sa.Column("report", sa.JSON(none_as_null=True), nullable=False),
        sa.Column("skipped", sa.JSON(none_as_null=True), nullable=False),
        sa.Column("html", sa.Text(), nullable=True),
        sa.CheckConstraint(
            "verdict IN ('effect', 'none', 'unexplained')", name=op.f("ck_studies_verdict")
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_studies")),
    )

    op.create_table(
        "models",
        sa.Column("number", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("version", sa.String(length=256), nullable=False),
        sa.Column("effects", sa.JSON(none_as_null=True), nullable=False),
        sa.Column("study_id", sa.Integer(), nullable=False),
        sa.Column("adopted_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("adopted_by", sa.String(length=64), nullable=False),
        sa.Column("withdrawn_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column("withdrawn_by", sa.String(length=64), nullable=True),
        sa.ForeignKeyConstraint(
            ["study_id"], ["studies.id"], name=op.f("fk_models_study_id_studies")
        ),
        sa.PrimaryKeyConstraint("number", name=op.f("pk_models")),
    )
    op.create_index(op.f("ix_models_study_id"), "models", ["study_id"], unique=False)

    op.add_column("plant", sa.Column("declared", sa.JSON(none_as_null=True), nullable=True))
    op.add_column("surfaces", sa.Column("model_version", sa.String(length=256), nullable=True))
    # All surfaces so far that came from photographs were made by the declared model.
    op.execute(
        "UPDATE surfaces SET model_version = '1:none' WHERE source IN ('network', 'refined')"
    )
    _resize_model_version(128, 256)


def downgrade() -> None:
    _resize_model_version(256, 128)
    op.drop_column("surfaces", "model_version")
    op.drop_column("plant", "declared")
    op.drop_table("models")
    op.drop_table("studies")


def _resize_model_version(old: int, new: int) -> None:
    with op.batch_alter_table("forecasts") as forecasts:
        forecasts.alter_column(
            "model_version",
            existing_type=sa.String(length=old),
            type_=sa.String(length=new),
            existing_nullable=False,
            postgresql_using=f"left(model_version, {new})",
        )
