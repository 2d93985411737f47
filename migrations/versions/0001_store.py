"""Plant, heliostats, targets, images, measurements, surfaces and forecasts."""

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "heliostats",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("name", sa.String(length=64), nullable=False),
        sa.Column("properties", sa.JSON(none_as_null=True), nullable=False),
        sa.Column("east_m", sa.Double(), nullable=False),
        sa.Column("north_m", sa.Double(), nullable=False),
        sa.Column("up_m", sa.Double(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("updated_at", sa.DateTime(timezone=True), nullable=False),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_heliostats")),
        sa.UniqueConstraint("name", name=op.f("uq_heliostats_name")),
    )
    op.create_table(
        "images",
        sa.Column("sha256", sa.String(length=64), nullable=False),
        sa.Column("media_type", sa.String(length=32), nullable=False),
        sa.Column("size_bytes", sa.Integer(), nullable=False),
        sa.Column("width_px", sa.Integer(), nullable=False),
        sa.Column("height_px", sa.Integer(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.PrimaryKeyConstraint("sha256", name=op.f("pk_images")),
    )
    op.create_table(
        "plant",
        sa.Column("id", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("name", sa.String(length=64), nullable=False),
        sa.Column("latitude_deg", sa.Double(), nullable=False),
        sa.Column("longitude_deg", sa.Double(), nullable=False),
        sa.Column("altitude_m", sa.Double(), nullable=False),
        sa.CheckConstraint("id = 1", name=op.f("ck_plant_single")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_plant")),
    )
    op.create_table(
        "targets",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("name", sa.String(length=64), nullable=False),
        sa.Column("center_m", sa.JSON(none_as_null=True), nullable=False),
        sa.Column("normal", sa.JSON(none_as_null=True), nullable=False),
        sa.Column("up", sa.JSON(none_as_null=True), nullable=False),
        sa.Column("width_m", sa.Double(), nullable=False),
        sa.Column("height_m", sa.Double(), nullable=False),
        sa.Column("corners", sa.JSON(none_as_null=True), nullable=True),
        sa.Column("updated_at", sa.DateTime(timezone=True), nullable=False),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_targets")),
        sa.UniqueConstraint("name", name=op.f("uq_targets_name")),
    )
    op.create_table(
        "measurements",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("heliostat_id", sa.Integer(), nullable=False),
        sa.Column("identifier", sa.String(length=96), nullable=False),
        sa.Column("external_id", sa.String(length=64), nullable=True),
        sa.Column("image_sha256", sa.String(length=64), nullable=False),
        sa.Column("kind", sa.String(length=16), nullable=False),
        sa.Column("target_id", sa.Integer(), nullable=False),
        sa.Column("sun_azimuth_deg", sa.Double(), nullable=False),
        sa.Column("sun_elevation_deg", sa.Double(), nullable=False),
        sa.Column("motor_axis_1", sa.Double(), nullable=True),
        sa.Column("motor_axis_2", sa.Double(), nullable=True),
        sa.Column("taken_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column("focal_spot_wgs84", sa.JSON(none_as_null=True), nullable=True),
        sa.Column("corners_px", sa.JSON(none_as_null=True), nullable=True),
        sa.Column("accepted", sa.Boolean(), nullable=False),
        sa.Column("reason", sa.String(length=64), nullable=True),
        sa.Column("quality", sa.JSON(none_as_null=True), nullable=False),
        sa.Column("center_right_m", sa.Double(), nullable=True),
        sa.Column("center_up_m", sa.Double(), nullable=True),
        sa.Column("arrays", sa.LargeBinary(), nullable=True),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.CheckConstraint(
            "kind IN ('raw', 'cropped', 'flux', 'flux-centered')", name=op.f("ck_measurements_kind")
        ),
        sa.ForeignKeyConstraint(
            ["heliostat_id"],
            ["heliostats.id"],
            name=op.f("fk_measurements_heliostat_id_heliostats"),
        ),
        sa.ForeignKeyConstraint(
            ["image_sha256"], ["images.sha256"], name=op.f("fk_measurements_image_sha256_images")
        ),
        sa.ForeignKeyConstraint(
            ["target_id"], ["targets.id"], name=op.f("fk_measurements_target_id_targets")
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_measurements")),
        sa.UniqueConstraint(
            "heliostat_id", "identifier", name=op.f("uq_measurements_heliostat_id_identifier")
        ),
        sa.UniqueConstraint(
            "heliostat_id",
            "image_sha256",
            "kind",
            name=op.f("uq_measurements_heliostat_id_image_sha256_kind"),
        ),
    )
    op.create_index(
        op.f("ix_measurements_heliostat_id_accepted"),
        "measurements",
        ["heliostat_id", "accepted"],
        unique=False,
    )
    op.create_index(
        op.f("ix_measurements_image_sha256"), "measurements", ["image_sha256"], unique=False
    )
    op.create_index(op.f("ix_measurements_target_id"), "measurements", ["target_id"], unique=False)

    op.create_table(
        "surfaces",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("heliostat_id", sa.Integer(), nullable=False),
        sa.Column("version", sa.Integer(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("valid_from", sa.DateTime(timezone=True), nullable=False),
        sa.Column("source", sa.String(length=16), nullable=False),
        sa.Column("model", sa.String(length=128), nullable=True),
        sa.Column("misfit", sa.Double(), nullable=True),
        sa.Column("content_sha256", sa.String(length=64), nullable=True),
        sa.Column("arrays", sa.LargeBinary(), nullable=False),
        sa.CheckConstraint(
            "source IN ('measured', 'network', 'refined', 'imported')",
            name=op.f("ck_surfaces_source"),
        ),
        sa.ForeignKeyConstraint(
            ["heliostat_id"], ["heliostats.id"], name=op.f("fk_surfaces_heliostat_id_heliostats")
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_surfaces")),
        sa.UniqueConstraint(
            "heliostat_id", "content_sha256", name=op.f("uq_surfaces_heliostat_id_content_sha256")
        ),
        sa.UniqueConstraint(
            "heliostat_id", "version", name=op.f("uq_surfaces_heliostat_id_version")
        ),
    )
    op.create_index(
        op.f("ix_surfaces_heliostat_id_valid_from"),
        "surfaces",
        ["heliostat_id", "valid_from"],
        unique=False,
    )

    op.create_table(
        "forecasts",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("heliostat_id", sa.Integer(), nullable=False),
        sa.Column("surface_id", sa.Integer(), nullable=True),
        sa.Column("target_name", sa.String(length=64), nullable=True),
        sa.Column("plane", sa.JSON(none_as_null=True), nullable=False),
        sa.Column("sun_azimuth_deg", sa.Double(), nullable=False),
        sa.Column("sun_elevation_deg", sa.Double(), nullable=False),
        sa.Column("aim_point_m", sa.JSON(none_as_null=True), nullable=True),
        sa.Column("dni_w_m2", sa.Double(), nullable=False),
        sa.Column("window_m", sa.Double(), nullable=True),
        sa.Column("normalised", sa.Boolean(), nullable=False),
        sa.Column("rows", sa.Integer(), nullable=False),
        sa.Column("columns", sa.Integer(), nullable=False),
        sa.Column("peak_w_m2", sa.Double(), nullable=False),
        sa.Column("power_w", sa.Double(), nullable=False),
        sa.Column("center_right_m", sa.Double(), nullable=True),
        sa.Column("center_up_m", sa.Double(), nullable=True),
        sa.Column("model_version", sa.String(length=128), nullable=False),
        sa.Column("flux", sa.LargeBinary(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(
            ["heliostat_id"], ["heliostats.id"], name=op.f("fk_forecasts_heliostat_id_heliostats")
        ),
        sa.ForeignKeyConstraint(
            ["surface_id"], ["surfaces.id"], name=op.f("fk_forecasts_surface_id_surfaces")
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_forecasts")),
    )
    op.create_index(op.f("ix_forecasts_heliostat_id"), "forecasts", ["heliostat_id"], unique=False)
    op.create_index(op.f("ix_forecasts_surface_id"), "forecasts", ["surface_id"], unique=False)

    op.create_table(
        "surface_measurements",
        sa.Column("surface_id", sa.Integer(), nullable=False),
        sa.Column("measurement_id", sa.Integer(), nullable=False),
        sa.ForeignKeyConstraint(
            ["measurement_id"],
            ["measurements.id"],
            name=op.f("fk_surface_measurements_measurement_id_measurements"),
        ),
        sa.ForeignKeyConstraint(
            ["surface_id"],
            ["surfaces.id"],
            name=op.f("fk_surface_measurements_surface_id_surfaces"),
        ),
        sa.PrimaryKeyConstraint(
            "surface_id", "measurement_id", name=op.f("pk_surface_measurements")
        ),
    )
    op.create_index(
        op.f("ix_surface_measurements_measurement_id"),
        "surface_measurements",
        ["measurement_id"],
        unique=False,
    )


def downgrade() -> None:
    op.drop_table("surface_measurements")
    op.drop_table("forecasts")
    op.drop_table("surfaces")
    op.drop_table("measurements")
    op.drop_table("targets")
    op.drop_table("plant")
    op.drop_table("images")
    op.drop_table("heliostats")
