"""The database tables, one typed class each. Column names include units.

Arrays are compressed npz blobs that load on demand. Images are files
(`service.store.image_files`), referred to by their SHA-256.
"""

from collections.abc import Mapping
from datetime import datetime
from typing import Any

from sqlalchemy import (
    BigInteger,
    CheckConstraint,
    Column,
    ForeignKey,
    Index,
    LargeBinary,
    String,
    Table,
    Text,
    UniqueConstraint,
    false,
    text,
)
from sqlalchemy.orm import Mapped, mapped_column, relationship

from service.base.fields import JsonObject, Sun
from service.store.columns import EPOCH, Base, now, one_of

NO_IMAGE = "none"
"""Kind of a measurement without an image: motor positions and a focal spot."""

KINDS = ("raw", "cropped", "flux", "flux-centered", NO_IMAGE)
SUN_CONTRADICTS_TIME = "sun_contradicts_time"
"""Warning type: the sent sun position contradicts the sent time."""

UNLIKE_HELIOSTAT = "unlike_heliostat"
"""Warning type: another heliostat's surface predicts the photograph much better."""

SOURCES = ("measured", "network", "refined", "imported")
VERDICTS = ("effect", "none", "unexplained")

MODEL_VERSION = 256
"""Maximum length of a model version: its number and the names of all effects."""


class PlantRow(Base):
    """The plant: a single row, written before anything that needs its origin.

    - ``declared`` is what ``twin.json`` declares for the first version of the plant's model
      (DESIGN.md, section 6). None means the defaults.
    - ``tower`` has ``radius_m`` and ``height_m`` of the tower, which casts a shadow.
    - ``time_zone`` and ``heliostat_types`` are those of its ``plant.yaml``, if it had one: the
      entries, and the text of the files that they name.
    """

    __tablename__ = "plant"
    __table_args__ = (CheckConstraint("id = 1", name="single"),)

    id: Mapped[int] = mapped_column(primary_key=True, autoincrement=False, default=1)
    name: Mapped[str] = mapped_column(String(64))
    latitude_deg: Mapped[float]
    longitude_deg: Mapped[float]
    altitude_m: Mapped[float]
    declared: Mapped[JsonObject | None]
    tower: Mapped[dict[str, float] | None]
    time_zone: Mapped[str | None] = mapped_column(String(64))
    heliostat_types: Mapped[JsonObject | None]

    @property
    def origin(self) -> tuple[float, float, float]:
        """The tower base in WGS84 [deg, deg, m]."""
        return self.latitude_deg, self.longitude_deg, self.altitude_m


class HeliostatRow(Base):
    """A heliostat: its PAINT properties as received, and its ENU position [m] for queries.

    ``photographs_changed_at`` is when a stored photograph was last completed or deleted.
    """

    __tablename__ = "heliostats"

    id: Mapped[int] = mapped_column(primary_key=True)
    name: Mapped[str] = mapped_column(String(64), unique=True)
    properties: Mapped[dict[str, Any]]
    east_m: Mapped[float]
    north_m: Mapped[float]
    up_m: Mapped[float]
    created_at: Mapped[datetime] = mapped_column(default=now)
    updated_at: Mapped[datetime] = mapped_column(default=now, onupdate=now)
    photographs_changed_at: Mapped[datetime | None]

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height of the mirror [m]; PAINT's documents name them without their unit."""
        known = self.properties
        suffix = "_m" if "width_m" in known else ""
        return float(known[f"width{suffix}"]), float(known[f"height{suffix}"])


class TargetRow(Base):
    """A target plane in ENU [m].

    - ``geometry`` is a `service.base.fields.Plane`.
    - ``corners`` are its WGS84 corners, if known.
    - ``locator`` is how photographs show where it is (`model.locating`), if it is declared.
    """

    __tablename__ = "targets"

    id: Mapped[int] = mapped_column(primary_key=True)
    name: Mapped[str] = mapped_column(String(64), unique=True)
    geometry: Mapped[JsonObject]
    corners: Mapped[dict[str, list[float]] | None]
    locator: Mapped[dict[str, object] | None]
    updated_at: Mapped[datetime] = mapped_column(default=now, onupdate=now)


class ReceiverRow(Base):
    """A receiver in ENU [m], of a ``kind`` of `service.base.plant`.

    ``geometry`` has the other fields of its document.
    """

    __tablename__ = "receivers"

    id: Mapped[int] = mapped_column(primary_key=True)
    name: Mapped[str] = mapped_column(String(64), unique=True)
    kind: Mapped[str] = mapped_column(String(16))
    geometry: Mapped[JsonObject]
    updated_at: Mapped[datetime] = mapped_column(default=now, onupdate=now)


class ImageRow(Base):
    """A stored image file by its hash; ``accepted`` if any of its measurements was.

    - ``pruned_at`` is when the file was marked for deletion
      (`service.store.image_files`), and ``pruned_for`` is why.
    - ``removed_at`` is when the file was deleted.
    - ``created_at`` is when it arrived, or arrived again after it was marked.
    """

    __tablename__ = "images"
    __table_args__ = (Index(None, "pruned_at", "accepted", "created_at"),)

    sha256: Mapped[str] = mapped_column(String(64), primary_key=True)
    media_type: Mapped[str] = mapped_column(String(32))
    size_bytes: Mapped[int]
    width_px: Mapped[int]
    height_px: Mapped[int]
    created_at: Mapped[datetime] = mapped_column(default=now)
    accepted: Mapped[bool] = mapped_column(server_default=false())
    pruned_at: Mapped[datetime | None]
    pruned_for: Mapped[str | None] = mapped_column(String(8))
    removed_at: Mapped[datetime | None]


class ImageTotalRow(Base):
    """Number and total size of stored images per verdict, updated by every write of `ImageRow`."""

    __tablename__ = "image_totals"

    accepted: Mapped[bool] = mapped_column(primary_key=True)
    images: Mapped[int]
    size_bytes: Mapped[int] = mapped_column(BigInteger)


_WARNED = text("warnings IS NOT NULL")


class MeasurementRow(Base):
    """A measurement of a heliostat's focal spot in one photograph, or from motor positions only.

    - ``arrays`` holds npz ``flux`` and ``centered``. A refused image has neither, but a ``reason``.
      A centred image has all of it as ``square``, and no ``flux``.
    - ``kind`` is `NO_IMAGE` without an image. Such a measurement serves only mount calibration.
    - ``taken_at`` is None if the time is unknown.
    - ``warnings`` are documents with a ``type`` and a ``detail``; None if there are none.
    - ``center_right_m``, ``center_up_m`` are the centre of mass from the target's centre.
    - ``corrected_at`` is the time of the newest correction (`CorrectionRow`). An excluded
      measurement is not accepted, for the reason `excluded`.
    - ``sent_by`` is the name of the sender's key, or of the user who imported it.
    - ``forced`` is why it is stored although another heliostat has the same image.
    - ``forecast_accuracy`` [1] is that of the surface of its day, computed when the photograph
      arrived. That surface had not used the photograph. ``forecast_key`` is what else it was based
      on (`service.twin.surfaces.accuracy`).
    """

    __tablename__ = "measurements"
    __table_args__ = (
        UniqueConstraint("heliostat_id", "image_sha256", "kind"),
        UniqueConstraint("heliostat_id", "identifier"),
        Index(None, "heliostat_id", "accepted"),
        Index(None, "heliostat_id", "external_id"),
        Index(None, "taken_at", "id"),
        Index(None, "accepted", "taken_at", "id"),
        Index(None, "target_id", "taken_at", "id"),
        Index(
            "ix_measurements_warned", "heliostat_id", postgresql_where=_WARNED, sqlite_where=_WARNED
        ),
        one_of("kind", KINDS),
        CheckConstraint(f"(kind = '{NO_IMAGE}') = (image_sha256 IS NULL)", name="image"),
    )

    id: Mapped[int] = mapped_column(primary_key=True)
    heliostat_id: Mapped[int] = mapped_column(ForeignKey("heliostats.id"))
    identifier: Mapped[str] = mapped_column(String(96))
    external_id: Mapped[str | None] = mapped_column(String(64))
    image_sha256: Mapped[str | None] = mapped_column(ForeignKey("images.sha256"), index=True)
    kind: Mapped[str] = mapped_column(String(16))
    target_id: Mapped[int] = mapped_column(ForeignKey("targets.id"))
    sun_azimuth_deg: Mapped[float]
    sun_elevation_deg: Mapped[float]
    motor_axis_1: Mapped[float | None]
    motor_axis_2: Mapped[float | None]
    taken_at: Mapped[datetime | None]
    focal_spot_wgs84: Mapped[list[float] | None]
    helios_spot_wgs84: Mapped[list[float] | None]
    corners_px: Mapped[dict[str, Any] | None]
    wind_speed_m_s: Mapped[float | None]
    wind_from_deg: Mapped[float | None]
    temperature_c: Mapped[float | None]
    accepted: Mapped[bool]
    reason: Mapped[str | None] = mapped_column(String(64))
    quality: Mapped[dict[str, Any]]
    warnings: Mapped[list[dict[str, Any]] | None]
    center_right_m: Mapped[float | None]
    center_up_m: Mapped[float | None]
    arrays: Mapped[bytes | None] = mapped_column(LargeBinary, deferred=True)
    created_at: Mapped[datetime] = mapped_column(default=now)
    sent_by: Mapped[str | None] = mapped_column(Text)
    corrected_at: Mapped[datetime | None]
    forecast_accuracy: Mapped[float | None]
    forecast_key: Mapped[str | None] = mapped_column(String(200))
    forced: Mapped[str | None] = mapped_column(Text)

    target: Mapped[TargetRow] = relationship(lazy="joined", innerjoin=True)
    image: Mapped[ImageRow | None] = relationship(lazy="joined")

    @property
    def sun(self) -> Sun:
        """The recorded sun."""
        return Sun(azimuth_deg=self.sun_azimuth_deg, elevation_deg=self.sun_elevation_deg)

    def warning(self, type_: str) -> Mapping[str, Any] | None:
        """Its warning of a type; None without any."""
        return next((one for one in self.warnings or () if one["type"] == type_), None)

    @property
    def has_file(self) -> bool:
        """Whether the store has an image file of it."""
        return self.image is not None and self.image.pruned_at is None


class AliasRow(Base):
    """Another identifier of a measurement, from sending its image again."""

    __tablename__ = "measurement_aliases"

    heliostat_id: Mapped[int] = mapped_column(ForeignKey("heliostats.id"), primary_key=True)
    identifier: Mapped[str] = mapped_column(String(96), primary_key=True)
    measurement_id: Mapped[int] = mapped_column(ForeignKey("measurements.id"), index=True)


class CorrectionRow(Base):
    """A correction or exclusion of a photograph: the values ``before`` and ``after``."""

    __tablename__ = "corrections"

    id: Mapped[int] = mapped_column(primary_key=True)
    measurement_id: Mapped[int] = mapped_column(ForeignKey("measurements.id"), index=True)
    created_at: Mapped[datetime] = mapped_column(default=now)
    created_by: Mapped[str] = mapped_column(String(64))
    reason: Mapped[str] = mapped_column(String(200))
    before: Mapped[dict[str, Any]]
    after: Mapped[dict[str, Any]]


surface_measurements = Table(
    "surface_measurements",
    Base.metadata,
    Column("surface_id", ForeignKey("surfaces.id"), primary_key=True),
    Column("measurement_id", ForeignKey("measurements.id"), primary_key=True, index=True),
)


class SurfaceRow(Base):
    """One version of a heliostat's surface.

    - ``arrays`` holds npz ``z``, ``z_std`` (4, 8, 8) and ``control_points`` (4, 8, 8, 3) [m].
    - ``content_sha256`` is set if the same content must not be stored twice (imports). Predictions
      leave it empty.
    - ``valid_from`` is None if its start is unknown: measured surfaces, photographs without a time.
    - ``epoch_since`` is when the epoch of the mirror began that it describes, None if it never
      changed: photographs from before show another shape (`service.twin.surfaces.present_shape`).
    - ``is_candidate``: a candidate is never active (`service.store.decisions`).
    - ``model`` names the network weights, ``model_version`` the plant's model with its effects.
    - ``trusted``, ``warnings`` (sentences), ``warned_since``, ``acknowledged_at`` and
      ``acknowledged_by`` assess a prediction (`model.observation.SurfacePrediction`). Measured
      surfaces have none.
    - ``warned_since`` is when the heliostat's warnings began.
    - ``sun_span_deg`` is the largest angle between the sun directions of its photographs.
    - ``deleted`` names photographs that were used for it and deleted since.
    """

    __tablename__ = "surfaces"
    __table_args__ = (
        UniqueConstraint("heliostat_id", "version"),
        UniqueConstraint("heliostat_id", "content_sha256"),
        Index(None, "heliostat_id", "valid_from"),
        one_of("source", SOURCES),
    )

    id: Mapped[int] = mapped_column(primary_key=True)
    heliostat_id: Mapped[int] = mapped_column(ForeignKey("heliostats.id"))
    version: Mapped[int]
    created_at: Mapped[datetime] = mapped_column(default=now)
    valid_from: Mapped[datetime | None]
    epoch_since: Mapped[datetime | None]
    source: Mapped[str] = mapped_column(String(16))
    model: Mapped[str | None] = mapped_column(String(128))
    model_version: Mapped[str | None] = mapped_column(String(MODEL_VERSION))
    misfit: Mapped[float | None]
    content_sha256: Mapped[str | None] = mapped_column(String(64))
    is_candidate: Mapped[bool] = mapped_column(server_default=false())
    trusted: Mapped[bool | None]
    warnings: Mapped[list[str] | None]
    warned_since: Mapped[datetime | None]
    suspicious: Mapped[list[str] | None]
    mahalanobis_distance: Mapped[float | None]
    sun_span_deg: Mapped[float | None]
    acknowledged_at: Mapped[datetime | None]
    acknowledged_by: Mapped[str | None] = mapped_column(String(64))
    deleted: Mapped[list[str] | None]
    arrays: Mapped[bytes] = mapped_column(LargeBinary, deferred=True)

    measurements: Mapped[list[MeasurementRow]] = relationship(
        secondary=surface_measurements, order_by=MeasurementRow.id, lazy="selectin"
    )

    @property
    def outdated(self) -> list[MeasurementRow]:
        """Photographs used for it that were corrected or excluded since."""
        return [
            row
            for row in self.measurements
            if row.corrected_at is not None and row.corrected_at > self.created_at
        ]


class DecisionRow(Base):
    """A decision whether a surface version became active, and why.

    - ``previous`` is the version that was active before.
    - ``candidates_before`` lists the candidates until then, which undoing the decision restores.
    - ``accuracy_before`` and ``accuracy_after`` [1] are those of the former and of this surface.
    """

    __tablename__ = "surface_decisions"

    id: Mapped[int] = mapped_column(primary_key=True)
    heliostat_id: Mapped[int] = mapped_column(ForeignKey("heliostats.id"), index=True)
    surface_id: Mapped[int] = mapped_column(ForeignKey("surfaces.id"))
    previous: Mapped[int | None]
    became_active: Mapped[bool]
    created_at: Mapped[datetime] = mapped_column(default=now)
    created_by: Mapped[str] = mapped_column(String(64))
    reason: Mapped[str] = mapped_column(String(200))
    accuracy_before: Mapped[float | None]
    accuracy_after: Mapped[float | None]
    photographs: Mapped[int]
    candidates_before: Mapped[list[int]]

    surface: Mapped[SurfaceRow] = relationship(lazy="joined", innerjoin=True)


class MountRow(Base):
    """One calibration of a mount, as in `model.pointing.report.mount_to_json`.

    ``valid_from`` is the start of its newest state. It is None if no measurement of the calibration
    has a time.
    """

    __tablename__ = "mounts"
    __table_args__ = (
        UniqueConstraint("heliostat_id", "version"),
        Index(None, "heliostat_id", "valid_from"),
    )

    id: Mapped[int] = mapped_column(primary_key=True)
    heliostat_id: Mapped[int] = mapped_column(ForeignKey("heliostats.id"))
    version: Mapped[int]
    created_at: Mapped[datetime] = mapped_column(default=now)
    valid_from: Mapped[datetime | None]
    document: Mapped[dict[str, Any]] = mapped_column(deferred=True)


class DriftRow(Base):
    """Flux accuracy [1] of a heliostat's surface on its newest photograph, on arrival.

    See `service.twin.surfaces.accuracy`.

    - ``poor_since`` is the first of the latest consecutive photographs below the accuracy limit of
      the settings.
    """

    __tablename__ = "drift"

    heliostat_id: Mapped[int] = mapped_column(
        ForeignKey("heliostats.id"), primary_key=True, autoincrement=False
    )
    measurement_id: Mapped[int] = mapped_column(ForeignKey("measurements.id"))
    surface_id: Mapped[int] = mapped_column(ForeignKey("surfaces.id"))
    taken_at: Mapped[datetime]
    accuracy: Mapped[float]
    poor_since: Mapped[datetime | None]


class HeliostatStateRow(Base):
    """Results of a heliostat that take long to compute, and the keys of what they are based on.

    A result is valid as long as its key is that of the data (`service.twin.alarms.field_overview`).

    - ``surface_id`` is the surface of ``deviation_mm`` and ``uncertainty_mm``.
    - ``accuracy`` is the mean over ``held_out`` photographs [1]; None if there are none.
    - ``accuracies`` [1] are those of the active surface on the newest photographs, by their row
      ids, under ``series_key``.
    - ``fall`` is their `service.twin.surfaces.present_shape.AccuracyFall`.
    - ``pointing`` is a `service.twin.pointing_errors.PointingState`.
    """

    __tablename__ = "heliostat_state"

    heliostat_id: Mapped[int] = mapped_column(
        ForeignKey("heliostats.id"), primary_key=True, autoincrement=False
    )
    computed_at: Mapped[datetime] = mapped_column(default=now)
    surface_id: Mapped[int | None]
    deviation_mm: Mapped[float | None]
    uncertainty_mm: Mapped[float | None]
    accuracy_key: Mapped[str | None] = mapped_column(String(200))
    accuracy: Mapped[float | None]
    held_out: Mapped[int | None]
    series_key: Mapped[str | None] = mapped_column(String(200))
    accuracies: Mapped[dict[str, float] | None]
    fall: Mapped[dict[str, object] | None]
    pointing_key: Mapped[str | None] = mapped_column(String(200))
    pointing: Mapped[dict[str, object] | None]


class FieldStateRow(Base):
    """When the alarms were computed, and from what: a single row.

    - ``revision`` counts writes of alarms, and ``states`` those of `HeliostatStateRow`.
    - ``marks`` are the newest rows behind the alarms (`service.twin.alarms.field_overview`).
    - ``pending`` heliostats had no valid results then.
    - ``cameras`` are `service.twin.studies.cameras.CameraChange`.
    - ``levels`` [1] of the accuracy are by the times of the days' last photographs
      (`service.twin.alarms.field_fall`).
    - ``pointing_limit_mrad`` is the limit of the settings behind the pointing of all heliostats.
    """

    __tablename__ = "field_state"
    __table_args__ = (CheckConstraint("id = 1", name="single"),)

    id: Mapped[int] = mapped_column(primary_key=True, autoincrement=False, default=1)
    revision: Mapped[int] = mapped_column(default=0)
    states: Mapped[int] = mapped_column(default=0)
    computed_at: Mapped[datetime] = mapped_column(default=EPOCH)
    marks: Mapped[str] = mapped_column(Text, default="")
    pending: Mapped[int] = mapped_column(default=0)
    cameras: Mapped[list[dict[str, object]]] = mapped_column(default=list)
    levels: Mapped[dict[str, float] | None]
    pointing_limit_mrad: Mapped[float | None]


class ForecastRow(Base):
    """A computed flux map: its inputs and key figures, and npz ``flux`` (rows, columns) float32
    [W/m2].

    ``document`` has the other fields of `service.web.resources.forecasts.ForecastSummary`.
    """

    __tablename__ = "forecasts"

    id: Mapped[int] = mapped_column(primary_key=True)
    heliostat_id: Mapped[int] = mapped_column(ForeignKey("heliostats.id"), index=True)
    surface_id: Mapped[int | None] = mapped_column(ForeignKey("surfaces.id"), index=True)
    target_name: Mapped[str | None] = mapped_column(String(64))
    document: Mapped[JsonObject]
    flux: Mapped[bytes] = mapped_column(LargeBinary, deferred=True)
    created_at: Mapped[datetime] = mapped_column(default=now)

    heliostat: Mapped[HeliostatRow] = relationship(lazy="joined", innerjoin=True)
    surface: Mapped[SurfaceRow | None] = relationship(lazy="joined")


class StudyRow(Base):
    """A study of stored photographs: its options, the data that it used, and its results.

    - ``model`` is the number of the plant's model at that time.
    - ``report`` is that of `model.study.study_to_json`.
    - ``html`` is the content of its report page. A report imported from a file has none.
    - ``first_taken_at`` and ``last_taken_at`` are the times of its first and last photograph.
    """

    __tablename__ = "studies"
    __table_args__ = (one_of("verdict", VERDICTS),)

    id: Mapped[int] = mapped_column(primary_key=True)
    created_at: Mapped[datetime] = mapped_column(default=now)
    created_by: Mapped[str] = mapped_column(String(64))
    options: Mapped[dict[str, Any]]
    heliostats: Mapped[list[str]]
    first_taken_at: Mapped[datetime | None]
    last_taken_at: Mapped[datetime | None]
    model: Mapped[int]
    model_version: Mapped[str] = mapped_column(String(MODEL_VERSION))
    verdict: Mapped[str] = mapped_column(String(16))
    conclusion: Mapped[str] = mapped_column(Text)
    report: Mapped[dict[str, Any]] = mapped_column(deferred=True)
    skipped: Mapped[dict[str, str]] = mapped_column(deferred=True)
    html: Mapped[str | None] = mapped_column(Text, deferred=True)


class ModelRow(Base):
    """A version of the plant's model after the first: adopted ``effects`` and the ``declared``
    model.

    ``study_id`` is the study that it was adopted from. Without one, the version came from a changed
    declaration. The first version has no row; its declaration is in the plant's row. Rows are never
    deleted, and change only by withdrawal. ``reason`` and ``withdrawn_reason`` are those that a
    person gave.
    """

    __tablename__ = "models"

    number: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    version: Mapped[str] = mapped_column(String(MODEL_VERSION))
    effects: Mapped[list[dict[str, Any]]]
    declared: Mapped[dict[str, Any] | None]
    study_id: Mapped[int | None] = mapped_column(ForeignKey("studies.id"), index=True)
    adopted_at: Mapped[datetime] = mapped_column(default=now)
    adopted_by: Mapped[str] = mapped_column(String(64))
    withdrawn_at: Mapped[datetime | None]
    withdrawn_by: Mapped[str | None] = mapped_column(String(64))
    reason: Mapped[str | None] = mapped_column(String(200))
    withdrawn_reason: Mapped[str | None] = mapped_column(String(200))
