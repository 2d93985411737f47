"""The tables: one typed class each; a column says its unit in its name.

Arrays live in compressed npz blobs that are loaded only when asked for; images live in files (`service.store.images`)
and are referred to by their SHA-256.
"""

from datetime import datetime
from typing import Any

from sqlalchemy import (
    BigInteger,
    CheckConstraint,
    Column,
    Computed,
    ForeignKey,
    Index,
    LargeBinary,
    String,
    Table,
    Text,
    UniqueConstraint,
    false,
)
from sqlalchemy.orm import Mapped, mapped_column, relationship

from service.store.columns import Base, now, one_of

KINDS = ("raw", "cropped", "flux", "flux-centered")
SOURCES = ("measured", "network", "refined", "imported")
VERDICTS = ("effect", "none", "unexplained")

MODEL_VERSION = 256
"""Characters that name a version of the plant's model: its number and all effects of the catalogue."""


class PlantRow(Base):
    """The plant: one row, written before anything that needs its origin.

    ``declared`` is what ``twin.json`` declared of the first version of its model (DESIGN.md, section 6); the defaults
    without it.
    """

    __tablename__ = "plant"
    __table_args__ = (CheckConstraint("id = 1", name="single"),)

    id: Mapped[int] = mapped_column(primary_key=True, autoincrement=False, default=1)
    name: Mapped[str] = mapped_column(String(64))
    latitude_deg: Mapped[float]
    longitude_deg: Mapped[float]
    altitude_m: Mapped[float]
    declared: Mapped[dict[str, Any] | None]

    @property
    def origin(self) -> tuple[float, float, float]:
        """The tower base in WGS84 [deg, deg, m]."""
        return self.latitude_deg, self.longitude_deg, self.altitude_m


class HeliostatRow(Base):
    """A heliostat: its PAINT properties as they came, and its position in ENU [m] for queries."""

    __tablename__ = "heliostats"

    id: Mapped[int] = mapped_column(primary_key=True)
    name: Mapped[str] = mapped_column(String(64), unique=True)
    properties: Mapped[dict[str, Any]]
    east_m: Mapped[float]
    north_m: Mapped[float]
    up_m: Mapped[float]
    created_at: Mapped[datetime] = mapped_column(default=now)
    updated_at: Mapped[datetime] = mapped_column(default=now, onupdate=now)


class TargetRow(Base):
    """A target plane in ENU [m]; ``corners`` are the WGS84 corners that it was made from, where it was."""

    __tablename__ = "targets"

    id: Mapped[int] = mapped_column(primary_key=True)
    name: Mapped[str] = mapped_column(String(64), unique=True)
    center_m: Mapped[list[float]]
    normal: Mapped[list[float]]
    up: Mapped[list[float]]
    width_m: Mapped[float]
    height_m: Mapped[float]
    corners: Mapped[dict[str, Any] | None]
    updated_at: Mapped[datetime] = mapped_column(default=now, onupdate=now)


class ReceiverRow(Base):
    """A cylindrical receiver in ENU [m]; see `model.plant.Cylinder`."""

    __tablename__ = "receivers"

    id: Mapped[int] = mapped_column(primary_key=True)
    name: Mapped[str] = mapped_column(String(64), unique=True)
    center_m: Mapped[list[float]]
    normal: Mapped[list[float]]
    up: Mapped[list[float]]
    radius_m: Mapped[float]
    height_m: Mapped[float]
    opening_deg: Mapped[float]
    updated_at: Mapped[datetime] = mapped_column(default=now, onupdate=now)


class ImageRow(Base):
    """An image file in the store, by its content; ``accepted`` where a measurement of it was.

    ``pruned_at`` says since when the file is given up (`service.store.photographs`), ``pruned_for`` why, ``removed_at``
    since when it is gone. ``created_at`` is when it came, or came anew after it was given up.
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
    """How many images the store keeps, of one verdict, and their size: every write of `ImageRow` keeps it up."""

    __tablename__ = "image_totals"

    accepted: Mapped[bool] = mapped_column(primary_key=True)
    images: Mapped[int]
    size_bytes: Mapped[int] = mapped_column(BigInteger)


class MeasurementRow(Base):
    """One photograph of one heliostat's spot and what was measured in it.

    ``arrays`` holds npz ``flux`` and ``centered``; a refused image has neither and keeps its ``reason``.
    ``center_right_m``, ``center_up_m``: centre of mass from the target's centre. ``corrected_at``: since when it stands
    as it does, where it was corrected (`CorrectionRow`); an excluded one is not accepted for the reason `excluded`.
    ``forecast_accuracy`` [1]: how the surface of its day forecast it when it came, which had not seen it. ``moment`` is
    when it was taken or else came; the database works it out.
    """

    __tablename__ = "measurements"
    __table_args__ = (
        UniqueConstraint("heliostat_id", "image_sha256", "kind"),
        UniqueConstraint("heliostat_id", "identifier"),
        Index(None, "heliostat_id", "accepted"),
        Index(None, "heliostat_id", "external_id"),
        Index(None, "moment", "id"),
        Index(None, "accepted", "moment", "id"),
        Index(None, "target_id", "moment", "id"),
        one_of("kind", KINDS),
    )

    id: Mapped[int] = mapped_column(primary_key=True)
    heliostat_id: Mapped[int] = mapped_column(ForeignKey("heliostats.id"))
    identifier: Mapped[str] = mapped_column(String(96))
    external_id: Mapped[str | None] = mapped_column(String(64))
    image_sha256: Mapped[str] = mapped_column(ForeignKey("images.sha256"), index=True)
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
    center_right_m: Mapped[float | None]
    center_up_m: Mapped[float | None]
    arrays: Mapped[bytes | None] = mapped_column(LargeBinary, deferred=True)
    created_at: Mapped[datetime] = mapped_column(default=now)
    corrected_at: Mapped[datetime | None]
    forecast_accuracy: Mapped[float | None]
    moment: Mapped[datetime] = mapped_column(Computed("coalesce(taken_at, created_at)", True), nullable=True)

    target: Mapped[TargetRow] = relationship(lazy="joined", innerjoin=True)
    image: Mapped[ImageRow] = relationship(lazy="joined", innerjoin=True)


class CorrectionRow(Base):
    """What somebody corrected of a photograph, or that it was excluded: what stood there ``before``, and ``after``."""

    __tablename__ = "corrections"

    id: Mapped[int] = mapped_column(primary_key=True)
    measurement_id: Mapped[int] = mapped_column(ForeignKey("measurements.id"), index=True)
    made_at: Mapped[datetime] = mapped_column(default=now)
    made_by: Mapped[str] = mapped_column(String(64))
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
    """One version of a heliostat's surface; npz ``z``, ``z_std`` (4, 8, 8) and ``control_points`` (4, 8, 8, 3) [m].

    ``content_sha256`` is set where the same content must not be stored twice (imports); predictions leave it empty.
    What is ``set_aside`` is never current (`service.store.decisions`). ``model`` names the weights, ``model_version``
    the plant's model with its effects that a prediction was made by. Whether a prediction is ``trusted``
    (`model.observation.SurfacePrediction`) stands with its ``doubts`` in words, since when the heliostat has had any,
    and who has seen that; of a measured surface all of it is empty. ``sun_span_deg`` is the largest angle between the
    suns of its photographs.
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
    valid_from: Mapped[datetime]
    source: Mapped[str] = mapped_column(String(16))
    model: Mapped[str | None] = mapped_column(String(128))
    model_version: Mapped[str | None] = mapped_column(String(MODEL_VERSION))
    misfit: Mapped[float | None]
    content_sha256: Mapped[str | None] = mapped_column(String(64))
    set_aside: Mapped[bool] = mapped_column(server_default=false())
    trusted: Mapped[bool | None]
    doubts: Mapped[list[str] | None]
    doubted_since: Mapped[datetime | None]
    suspicious: Mapped[list[str] | None]
    strangeness: Mapped[float | None]
    sun_span_deg: Mapped[float | None]
    seen_at: Mapped[datetime | None]
    seen_by: Mapped[str | None] = mapped_column(String(64))
    arrays: Mapped[bytes] = mapped_column(LargeBinary, deferred=True)

    measurements: Mapped[list[MeasurementRow]] = relationship(
        secondary=surface_measurements, order_by=MeasurementRow.id, lazy="selectin"
    )

    @property
    def outdated(self) -> list[MeasurementRow]:
        """Photographs that it was made from, and that were corrected or excluded since."""
        return [row for row in self.measurements if row.corrected_at is not None and row.corrected_at > self.created_at]


class DecisionRow(Base):
    """That a version became a heliostat's surface of today, or did not, and on what grounds.

    ``previous`` is the version that was today's; ``set_aside_before`` are those that were set aside until then, which
    is what taking the decision back restores. Accuracies [1] are those of the former surface and of this one.
    """

    __tablename__ = "surface_decisions"

    id: Mapped[int] = mapped_column(primary_key=True)
    heliostat_id: Mapped[int] = mapped_column(ForeignKey("heliostats.id"), index=True)
    surface_id: Mapped[int] = mapped_column(ForeignKey("surfaces.id"))
    previous: Mapped[int | None]
    taken: Mapped[bool]
    made_at: Mapped[datetime] = mapped_column(default=now)
    made_by: Mapped[str] = mapped_column(String(64))
    reason: Mapped[str] = mapped_column(String(200))
    accuracy_before: Mapped[float | None]
    accuracy_after: Mapped[float | None]
    photographs: Mapped[int]
    set_aside_before: Mapped[list[int]]

    surface: Mapped[SurfaceRow] = relationship(lazy="joined", innerjoin=True)


class MountRow(Base):
    """One calibration of a mount, `model.pointing.report.mount_to_json`; since when its newest state is valid."""

    __tablename__ = "mounts"
    __table_args__ = (UniqueConstraint("heliostat_id", "version"), Index(None, "heliostat_id", "valid_from"))

    id: Mapped[int] = mapped_column(primary_key=True)
    heliostat_id: Mapped[int] = mapped_column(ForeignKey("heliostats.id"))
    version: Mapped[int]
    created_at: Mapped[datetime] = mapped_column(default=now)
    valid_from: Mapped[datetime]
    document: Mapped[dict[str, Any]] = mapped_column(deferred=True)


class DriftRow(Base):
    """Flux accuracy [1] of a heliostat's surface on its newest photograph, when that came (`service.twin.accuracy`).

    ``poor_since`` is the first of all its last photographs that were forecast worse than the settings bear. ``recent``
    and ``earlier`` are medians of its newest photographs and of those before, each when it came; that fell by
    ``least_drop`` at least (95 %), and ``fell_since`` then by more than the settings bear.
    """

    __tablename__ = "drift"

    heliostat_id: Mapped[int] = mapped_column(ForeignKey("heliostats.id"), primary_key=True, autoincrement=False)
    measurement_id: Mapped[int] = mapped_column(ForeignKey("measurements.id"))
    surface_id: Mapped[int] = mapped_column(ForeignKey("surfaces.id"))
    taken_at: Mapped[datetime]
    accuracy: Mapped[float]
    poor_since: Mapped[datetime | None]
    recent: Mapped[float | None]
    earlier: Mapped[float | None]
    least_drop: Mapped[float | None]
    fell_since: Mapped[datetime | None]


class ForecastRow(Base):
    """A computed flux map: its inputs, its npz ``flux`` (rows, columns) float32 [W/m2] and its figures.

    ``sun_at`` is the time that was asked for, where the sun was not asked for by its position.
    """

    __tablename__ = "forecasts"

    id: Mapped[int] = mapped_column(primary_key=True)
    heliostat_id: Mapped[int] = mapped_column(ForeignKey("heliostats.id"), index=True)
    surface_id: Mapped[int | None] = mapped_column(ForeignKey("surfaces.id"), index=True)
    target_name: Mapped[str | None] = mapped_column(String(64))
    plane: Mapped[dict[str, Any]]
    sun_azimuth_deg: Mapped[float]
    sun_elevation_deg: Mapped[float]
    sun_at: Mapped[datetime | None]
    aim_point_m: Mapped[list[float] | None]
    motor_position: Mapped[list[float] | None]
    dni_w_m2: Mapped[float]
    window_m: Mapped[float | None]
    normalised: Mapped[bool]
    rows: Mapped[int]
    columns: Mapped[int]
    peak_w_m2: Mapped[float]
    power_w: Mapped[float]
    center_right_m: Mapped[float | None]
    center_up_m: Mapped[float | None]
    model_version: Mapped[str] = mapped_column(String(MODEL_VERSION))
    flux: Mapped[bytes] = mapped_column(LargeBinary, deferred=True)
    created_at: Mapped[datetime] = mapped_column(default=now)

    heliostat: Mapped[HeliostatRow] = relationship(lazy="joined", innerjoin=True)
    surface: Mapped[SurfaceRow | None] = relationship(lazy="joined")


class StudyRow(Base):
    """A study of stored photographs: what was asked, what of it was looked at, and what it found.

    ``model`` is the number of the plant's model that it was made with, ``report`` that of `model.study.Study.to_json`,
    ``html`` the same as a page; a report from a file has no page. ``taken_from`` and ``taken_to`` are the first and the
    last moment of its photographs.
    """

    __tablename__ = "studies"
    __table_args__ = (one_of("verdict", VERDICTS),)

    id: Mapped[int] = mapped_column(primary_key=True)
    created_at: Mapped[datetime] = mapped_column(default=now)
    created_by: Mapped[str] = mapped_column(String(64))
    options: Mapped[dict[str, Any]]
    heliostats: Mapped[list[str]]
    taken_from: Mapped[datetime | None]
    taken_to: Mapped[datetime | None]
    model: Mapped[int]
    model_version: Mapped[str] = mapped_column(String(MODEL_VERSION))
    verdict: Mapped[str] = mapped_column(String(16))
    conclusion: Mapped[str] = mapped_column(Text)
    report: Mapped[dict[str, Any]] = mapped_column(deferred=True)
    skipped: Mapped[dict[str, Any]] = mapped_column(deferred=True)
    html: Mapped[str | None] = mapped_column(Text, deferred=True)


class ModelRow(Base):
    """A version of the plant's model from the second on: all its adopted ``effects`` upon what was ``declared`` then.

    ``study_id`` names the study that it was adopted from; without it the version came of another declaration. The first
    version is what the plant began with; it has no row, and the plant's ``declared`` is its own. Rows never change but
    for their withdrawal, and are never deleted.
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
