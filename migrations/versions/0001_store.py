"""All tables of 1.0.0. Later migrations begin from them, so this one never changes."""

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "api_keys",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("name", sa.String(length=64), nullable=False),
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("prefix", sa.String(length=16), nullable=False),
        sa.Column("sha256", sa.String(length=64), nullable=False),
        sa.Column("role", sa.String(length=16), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("expires_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column("last_used_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column("withdrawn_at", sa.DateTime(timezone=True), nullable=True),
        sa.CheckConstraint(
            "role IN ('read', 'ingest', 'operate', 'admin')", name=op.f("ck_api_keys_role")
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_api_keys")),
        sa.UniqueConstraint("name", "number", name=op.f("uq_api_keys_name_number")),
        sa.UniqueConstraint("prefix", name=op.f("uq_api_keys_prefix")),
    )
    op.create_table(
        "audit",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("actor", sa.String(length=64), nullable=False),
        sa.Column("action", sa.String(length=64), nullable=False),
        sa.Column("subject", sa.String(length=128), nullable=False),
        sa.Column("detail", sa.JSON(), nullable=False),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_audit")),
    )
    op.create_index(op.f("ix_audit_subject_id"), "audit", ["subject", "id"], unique=False)
    op.create_table(
        "field_state",
        sa.Column("id", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("revision", sa.Integer(), nullable=False),
        sa.Column("states", sa.Integer(), nullable=False),
        sa.Column("computed_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("marks", sa.Text(), nullable=False),
        sa.Column("pending", sa.Integer(), nullable=False),
        sa.Column("cameras", sa.JSON(), nullable=False),
        sa.Column("pointing_limit_mrad", sa.Double(), nullable=True),
        sa.CheckConstraint("id = 1", name=op.f("ck_field_state_single")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_field_state")),
    )
    op.create_table(
        "heliostats",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("name", sa.String(length=64), nullable=False),
        sa.Column("properties", sa.JSON(), nullable=False),
        sa.Column("east_m", sa.Double(), nullable=False),
        sa.Column("north_m", sa.Double(), nullable=False),
        sa.Column("up_m", sa.Double(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("updated_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("photographs_changed_at", sa.DateTime(timezone=True), nullable=True),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_heliostats")),
        sa.UniqueConstraint("name", name=op.f("uq_heliostats_name")),
    )
    op.create_table(
        "image_totals",
        sa.Column("accepted", sa.Boolean(), nullable=False),
        sa.Column("images", sa.Integer(), nullable=False),
        sa.Column("size_bytes", sa.BigInteger(), nullable=False),
        sa.PrimaryKeyConstraint("accepted", name=op.f("pk_image_totals")),
    )
    op.create_table(
        "images",
        sa.Column("sha256", sa.String(length=64), nullable=False),
        sa.Column("media_type", sa.String(length=32), nullable=False),
        sa.Column("size_bytes", sa.Integer(), nullable=False),
        sa.Column("width_px", sa.Integer(), nullable=False),
        sa.Column("height_px", sa.Integer(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("accepted", sa.Boolean(), server_default=sa.false(), nullable=False),
        sa.Column("pruned_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column("pruned_for", sa.String(length=8), nullable=True),
        sa.Column("removed_at", sa.DateTime(timezone=True), nullable=True),
        sa.PrimaryKeyConstraint("sha256", name=op.f("pk_images")),
    )
    op.create_index(
        op.f("ix_images_pruned_at_accepted_created_at"),
        "images",
        ["pruned_at", "accepted", "created_at"],
        unique=False,
    )
    op.create_table(
        "jobs",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("kind", sa.String(length=32), nullable=False),
        sa.Column("payload", sa.JSON(), nullable=False),
        sa.Column("state", sa.String(length=16), nullable=False),
        sa.Column("created_by", sa.String(length=64), nullable=False),
        sa.Column("idempotency_key", sa.String(length=128), nullable=True),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("not_before", sa.DateTime(timezone=True), nullable=False),
        sa.Column("started_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column("finished_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column("attempted_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column("attempts", sa.Integer(), nullable=False),
        sa.Column("attempts_before_progress", sa.Integer(), server_default="0", nullable=False),
        sa.Column("is_short", sa.Boolean(), server_default=sa.false(), nullable=False),
        sa.Column("cancel_requested", sa.Boolean(), nullable=False),
        sa.Column("progress", sa.Double(), nullable=False),
        sa.Column("message", sa.String(length=200), nullable=False),
        sa.Column("phase", sa.String(length=100), server_default="", nullable=False),
        sa.Column("n_done", sa.Integer(), nullable=True),
        sa.Column("n_total", sa.Integer(), nullable=True),
        sa.Column("remaining_s", sa.Double(), nullable=True),
        sa.Column("revision", sa.Integer(), nullable=False),
        sa.Column("worker", sa.String(length=96), nullable=True),
        sa.Column("lease_token", sa.String(length=32), nullable=True),
        sa.Column("lease_until", sa.DateTime(timezone=True), nullable=True),
        sa.Column("reason", sa.String(length=1000), nullable=True),
        sa.Column("result", sa.JSON(), nullable=True),
        sa.Column("arrays", sa.LargeBinary(), nullable=True),
        sa.CheckConstraint(
            "state IN ('queued', 'running', 'done', 'failed', 'cancelled')",
            name=op.f("ck_jobs_state"),
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_jobs")),
        sa.UniqueConstraint(
            "created_by", "idempotency_key", name=op.f("uq_jobs_created_by_idempotency_key")
        ),
    )
    op.create_index(
        op.f("ix_jobs_created_by_attempted_at"),
        "jobs",
        ["created_by", "attempted_at"],
        unique=False,
    )
    op.create_index(op.f("ix_jobs_state_not_before"), "jobs", ["state", "not_before"], unique=False)
    op.create_table(
        "plant",
        sa.Column("id", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("name", sa.String(length=64), nullable=False),
        sa.Column("latitude_deg", sa.Double(), nullable=False),
        sa.Column("longitude_deg", sa.Double(), nullable=False),
        sa.Column("altitude_m", sa.Double(), nullable=False),
        sa.Column("declared", sa.JSON(), nullable=True),
        sa.Column("tower", sa.JSON(), nullable=True),
        sa.Column("time_zone", sa.String(length=64), nullable=True),
        sa.Column("heliostat_types", sa.JSON(), nullable=True),
        sa.CheckConstraint("id = 1", name=op.f("ck_plant_single")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_plant")),
    )
    op.create_table(
        "receivers",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("name", sa.String(length=64), nullable=False),
        sa.Column("kind", sa.String(length=16), nullable=False),
        sa.Column("geometry", sa.JSON(), nullable=False),
        sa.Column("updated_at", sa.DateTime(timezone=True), nullable=False),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_receivers")),
        sa.UniqueConstraint("name", name=op.f("uq_receivers_name")),
    )
    op.create_table(
        "studies",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("created_by", sa.String(length=64), nullable=False),
        sa.Column("options", sa.JSON(), nullable=False),
        sa.Column("heliostats", sa.JSON(), nullable=False),
        sa.Column("first_taken_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column("last_taken_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column("model", sa.Integer(), nullable=False),
        sa.Column("model_version", sa.String(length=256), nullable=False),
        sa.Column("verdict", sa.String(length=16), nullable=False),
        sa.Column("conclusion", sa.Text(), nullable=False),
        sa.Column("report", sa.JSON(), nullable=False),
        sa.Column("skipped", sa.JSON(), nullable=False),
        sa.Column("html", sa.Text(), nullable=True),
        sa.CheckConstraint(
            "verdict IN ('effect', 'none', 'unexplained')", name=op.f("ck_studies_verdict")
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_studies")),
    )
    op.create_table(
        "targets",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("name", sa.String(length=64), nullable=False),
        sa.Column("geometry", sa.JSON(), nullable=False),
        sa.Column("corners", sa.JSON(), nullable=True),
        sa.Column("locator", sa.JSON(), nullable=True),
        sa.Column("updated_at", sa.DateTime(timezone=True), nullable=False),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_targets")),
        sa.UniqueConstraint("name", name=op.f("uq_targets_name")),
    )
    op.create_table(
        "acknowledgements",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("heliostat_id", sa.Integer(), nullable=True),
        sa.Column("reason", sa.String(length=32), nullable=False),
        sa.Column("fingerprint", sa.String(length=96), nullable=False),
        sa.Column("made_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("made_by", sa.String(length=64), nullable=False),
        sa.Column("batch", sa.Integer(), nullable=True),
        sa.Column("comment", sa.String(length=200), server_default="", nullable=False),
        sa.Column("undone_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column("undone_by", sa.String(length=64), nullable=True),
        sa.ForeignKeyConstraint(
            ["heliostat_id"],
            ["heliostats.id"],
            name=op.f("fk_acknowledgements_heliostat_id_heliostats"),
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_acknowledgements")),
    )
    op.create_index(op.f("ix_acknowledgements_batch"), "acknowledgements", ["batch"], unique=False)
    op.create_index(
        op.f("ix_acknowledgements_heliostat_id"), "acknowledgements", ["heliostat_id"], unique=False
    )
    op.create_table(
        "alarms",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("heliostat_id", sa.Integer(), nullable=True),
        sa.Column("reason", sa.String(length=32), nullable=False),
        sa.Column("fingerprint", sa.String(length=96), nullable=False),
        sa.Column("message", sa.Text(), nullable=False),
        sa.Column("action", sa.Text(), nullable=False),
        sa.Column("measurements", sa.JSON(), nullable=False),
        sa.Column("offer", sa.JSON(), nullable=True),
        sa.Column("since", sa.DateTime(timezone=True), nullable=False),
        sa.Column("recorded_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("ended_at", sa.DateTime(timezone=True), nullable=True),
        sa.ForeignKeyConstraint(
            ["heliostat_id"], ["heliostats.id"], name=op.f("fk_alarms_heliostat_id_heliostats")
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_alarms")),
    )
    op.create_index(op.f("ix_alarms_ended_at"), "alarms", ["ended_at"], unique=False)
    op.create_index(op.f("ix_alarms_heliostat_id"), "alarms", ["heliostat_id"], unique=False)
    op.create_table(
        "heliostat_state",
        sa.Column("heliostat_id", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("computed_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("surface_id", sa.Integer(), nullable=True),
        sa.Column("deviation_mm", sa.Double(), nullable=True),
        sa.Column("uncertainty_mm", sa.Double(), nullable=True),
        sa.Column("accuracy_key", sa.String(length=200), nullable=True),
        sa.Column("accuracy", sa.Double(), nullable=True),
        sa.Column("held_out", sa.Integer(), nullable=True),
        sa.Column("series_key", sa.String(length=200), nullable=True),
        sa.Column("accuracies", sa.JSON(), nullable=True),
        sa.Column("fall", sa.JSON(), nullable=True),
        sa.Column("pointing_key", sa.String(length=200), nullable=True),
        sa.Column("pointing", sa.JSON(), nullable=True),
        sa.ForeignKeyConstraint(
            ["heliostat_id"],
            ["heliostats.id"],
            name=op.f("fk_heliostat_state_heliostat_id_heliostats"),
        ),
        sa.PrimaryKeyConstraint("heliostat_id", name=op.f("pk_heliostat_state")),
    )
    op.create_table(
        "job_steps",
        sa.Column("job_id", sa.Integer(), nullable=False),
        sa.Column("name", sa.String(length=96), nullable=False),
        sa.Column("result", sa.JSON(), nullable=False),
        sa.Column("arrays", sa.LargeBinary(), nullable=True),
        sa.ForeignKeyConstraint(["job_id"], ["jobs.id"], name=op.f("fk_job_steps_job_id_jobs")),
        sa.PrimaryKeyConstraint("job_id", "name", name=op.f("pk_job_steps")),
    )
    op.create_table(
        "measurements",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("heliostat_id", sa.Integer(), nullable=False),
        sa.Column("identifier", sa.String(length=96), nullable=False),
        sa.Column("external_id", sa.String(length=64), nullable=True),
        sa.Column("image_sha256", sa.String(length=64), nullable=True),
        sa.Column("kind", sa.String(length=16), nullable=False),
        sa.Column("target_id", sa.Integer(), nullable=False),
        sa.Column("sun_azimuth_deg", sa.Double(), nullable=False),
        sa.Column("sun_elevation_deg", sa.Double(), nullable=False),
        sa.Column("motor_axis_1", sa.Double(), nullable=True),
        sa.Column("motor_axis_2", sa.Double(), nullable=True),
        sa.Column("taken_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column("focal_spot_wgs84", sa.JSON(), nullable=True),
        sa.Column("helios_spot_wgs84", sa.JSON(), nullable=True),
        sa.Column("corners_px", sa.JSON(), nullable=True),
        sa.Column("wind_speed_m_s", sa.Double(), nullable=True),
        sa.Column("wind_from_deg", sa.Double(), nullable=True),
        sa.Column("temperature_c", sa.Double(), nullable=True),
        sa.Column("accepted", sa.Boolean(), nullable=False),
        sa.Column("reason", sa.String(length=64), nullable=True),
        sa.Column("quality", sa.JSON(), nullable=False),
        sa.Column("warnings", sa.JSON(), nullable=True),
        sa.Column("center_right_m", sa.Double(), nullable=True),
        sa.Column("center_up_m", sa.Double(), nullable=True),
        sa.Column("arrays", sa.LargeBinary(), nullable=True),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("sent_by", sa.Text(), nullable=True),
        sa.Column("corrected_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column("forecast_accuracy", sa.Double(), nullable=True),
        sa.Column("forced", sa.Text(), nullable=True),
        sa.CheckConstraint(
            "(kind = 'none') = (image_sha256 IS NULL)", name=op.f("ck_measurements_image")
        ),
        sa.CheckConstraint(
            "kind IN ('raw', 'cropped', 'flux', 'flux-centered', 'none')",
            name=op.f("ck_measurements_kind"),
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
        op.f("ix_measurements_accepted_taken_at_id"),
        "measurements",
        ["accepted", "taken_at", "id"],
        unique=False,
    )
    op.create_index(
        op.f("ix_measurements_heliostat_id_accepted"),
        "measurements",
        ["heliostat_id", "accepted"],
        unique=False,
    )
    op.create_index(
        op.f("ix_measurements_heliostat_id_external_id"),
        "measurements",
        ["heliostat_id", "external_id"],
        unique=False,
    )
    op.create_index(
        op.f("ix_measurements_image_sha256"), "measurements", ["image_sha256"], unique=False
    )
    op.create_index(
        op.f("ix_measurements_taken_at_id"), "measurements", ["taken_at", "id"], unique=False
    )
    op.create_index(
        op.f("ix_measurements_target_id_taken_at_id"),
        "measurements",
        ["target_id", "taken_at", "id"],
        unique=False,
    )
    op.create_index(
        "ix_measurements_warned",
        "measurements",
        ["heliostat_id"],
        unique=False,
        postgresql_where=sa.text("warnings IS NOT NULL"),
        sqlite_where=sa.text("warnings IS NOT NULL"),
    )
    op.create_table(
        "models",
        sa.Column("number", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("version", sa.String(length=256), nullable=False),
        sa.Column("effects", sa.JSON(), nullable=False),
        sa.Column("declared", sa.JSON(), nullable=True),
        sa.Column("study_id", sa.Integer(), nullable=True),
        sa.Column("adopted_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("adopted_by", sa.String(length=64), nullable=False),
        sa.Column("withdrawn_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column("withdrawn_by", sa.String(length=64), nullable=True),
        sa.Column("reason", sa.String(length=200), nullable=True),
        sa.Column("withdrawn_reason", sa.String(length=200), nullable=True),
        sa.ForeignKeyConstraint(
            ["study_id"], ["studies.id"], name=op.f("fk_models_study_id_studies")
        ),
        sa.PrimaryKeyConstraint("number", name=op.f("pk_models")),
    )
    op.create_index(op.f("ix_models_study_id"), "models", ["study_id"], unique=False)
    op.create_table(
        "mounts",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("heliostat_id", sa.Integer(), nullable=False),
        sa.Column("version", sa.Integer(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("valid_from", sa.DateTime(timezone=True), nullable=True),
        sa.Column("document", sa.JSON(), nullable=False),
        sa.ForeignKeyConstraint(
            ["heliostat_id"], ["heliostats.id"], name=op.f("fk_mounts_heliostat_id_heliostats")
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_mounts")),
        sa.UniqueConstraint("heliostat_id", "version", name=op.f("uq_mounts_heliostat_id_version")),
    )
    op.create_index(
        op.f("ix_mounts_heliostat_id_valid_from"),
        "mounts",
        ["heliostat_id", "valid_from"],
        unique=False,
    )
    op.create_table(
        "sessions",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("key_id", sa.Integer(), nullable=False),
        sa.Column("sha256", sa.String(length=64), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("expires_at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(
            ["key_id"], ["api_keys.id"], name=op.f("fk_sessions_key_id_api_keys")
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_sessions")),
        sa.UniqueConstraint("sha256", name=op.f("uq_sessions_sha256")),
    )
    op.create_index(op.f("ix_sessions_key_id"), "sessions", ["key_id"], unique=False)
    op.create_table(
        "surfaces",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("heliostat_id", sa.Integer(), nullable=False),
        sa.Column("version", sa.Integer(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("valid_from", sa.DateTime(timezone=True), nullable=True),
        sa.Column("epoch_since", sa.DateTime(timezone=True), nullable=True),
        sa.Column("source", sa.String(length=16), nullable=False),
        sa.Column("model", sa.String(length=128), nullable=True),
        sa.Column("model_version", sa.String(length=256), nullable=True),
        sa.Column("misfit", sa.Double(), nullable=True),
        sa.Column("content_sha256", sa.String(length=64), nullable=True),
        sa.Column("is_candidate", sa.Boolean(), server_default=sa.false(), nullable=False),
        sa.Column("trusted", sa.Boolean(), nullable=True),
        sa.Column("warnings", sa.JSON(), nullable=True),
        sa.Column("warned_since", sa.DateTime(timezone=True), nullable=True),
        sa.Column("suspicious", sa.JSON(), nullable=True),
        sa.Column("mahalanobis_distance", sa.Double(), nullable=True),
        sa.Column("sun_span_deg", sa.Double(), nullable=True),
        sa.Column("acknowledged_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column("acknowledged_by", sa.String(length=64), nullable=True),
        sa.Column("deleted", sa.JSON(), nullable=True),
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
        "corrections",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("measurement_id", sa.Integer(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("created_by", sa.String(length=64), nullable=False),
        sa.Column("reason", sa.String(length=200), nullable=False),
        sa.Column("before", sa.JSON(), nullable=False),
        sa.Column("after", sa.JSON(), nullable=False),
        sa.ForeignKeyConstraint(
            ["measurement_id"],
            ["measurements.id"],
            name=op.f("fk_corrections_measurement_id_measurements"),
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_corrections")),
    )
    op.create_index(
        op.f("ix_corrections_measurement_id"), "corrections", ["measurement_id"], unique=False
    )
    op.create_table(
        "drift",
        sa.Column("heliostat_id", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("measurement_id", sa.Integer(), nullable=False),
        sa.Column("surface_id", sa.Integer(), nullable=False),
        sa.Column("taken_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("accuracy", sa.Double(), nullable=False),
        sa.Column("poor_since", sa.DateTime(timezone=True), nullable=True),
        sa.ForeignKeyConstraint(
            ["heliostat_id"], ["heliostats.id"], name=op.f("fk_drift_heliostat_id_heliostats")
        ),
        sa.ForeignKeyConstraint(
            ["measurement_id"],
            ["measurements.id"],
            name=op.f("fk_drift_measurement_id_measurements"),
        ),
        sa.ForeignKeyConstraint(
            ["surface_id"], ["surfaces.id"], name=op.f("fk_drift_surface_id_surfaces")
        ),
        sa.PrimaryKeyConstraint("heliostat_id", name=op.f("pk_drift")),
    )
    op.create_table(
        "forecasts",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("heliostat_id", sa.Integer(), nullable=False),
        sa.Column("surface_id", sa.Integer(), nullable=True),
        sa.Column("target_name", sa.String(length=64), nullable=True),
        sa.Column("document", sa.JSON(), nullable=False),
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
        "measurement_aliases",
        sa.Column("heliostat_id", sa.Integer(), nullable=False),
        sa.Column("identifier", sa.String(length=96), nullable=False),
        sa.Column("measurement_id", sa.Integer(), nullable=False),
        sa.ForeignKeyConstraint(
            ["heliostat_id"],
            ["heliostats.id"],
            name=op.f("fk_measurement_aliases_heliostat_id_heliostats"),
        ),
        sa.ForeignKeyConstraint(
            ["measurement_id"],
            ["measurements.id"],
            name=op.f("fk_measurement_aliases_measurement_id_measurements"),
        ),
        sa.PrimaryKeyConstraint("heliostat_id", "identifier", name=op.f("pk_measurement_aliases")),
    )
    op.create_index(
        op.f("ix_measurement_aliases_measurement_id"),
        "measurement_aliases",
        ["measurement_id"],
        unique=False,
    )
    op.create_table(
        "surface_decisions",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("heliostat_id", sa.Integer(), nullable=False),
        sa.Column("surface_id", sa.Integer(), nullable=False),
        sa.Column("previous", sa.Integer(), nullable=True),
        sa.Column("became_active", sa.Boolean(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("created_by", sa.String(length=64), nullable=False),
        sa.Column("reason", sa.String(length=200), nullable=False),
        sa.Column("accuracy_before", sa.Double(), nullable=True),
        sa.Column("accuracy_after", sa.Double(), nullable=True),
        sa.Column("photographs", sa.Integer(), nullable=False),
        sa.Column("candidates_before", sa.JSON(), nullable=False),
        sa.ForeignKeyConstraint(
            ["heliostat_id"],
            ["heliostats.id"],
            name=op.f("fk_surface_decisions_heliostat_id_heliostats"),
        ),
        sa.ForeignKeyConstraint(
            ["surface_id"], ["surfaces.id"], name=op.f("fk_surface_decisions_surface_id_surfaces")
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_surface_decisions")),
    )
    op.create_index(
        op.f("ix_surface_decisions_heliostat_id"),
        "surface_decisions",
        ["heliostat_id"],
        unique=False,
    )
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
    for table in (
        "surface_measurements",
        "surface_decisions",
        "measurement_aliases",
        "forecasts",
        "drift",
        "corrections",
        "surfaces",
        "sessions",
        "mounts",
        "models",
        "measurements",
        "job_steps",
        "heliostat_state",
        "alarms",
        "acknowledgements",
        "targets",
        "studies",
        "receivers",
        "plant",
        "jobs",
        "images",
        "image_totals",
        "heliostats",
        "field_state",
        "audit",
        "api_keys",
    ):
        op.drop_table(table)
