"""The kinds of job: what each takes, and the plain function that does it.

A new kind is its payload, its function and one line in `KINDS`; its route, its documentation and the workers follow.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, field_validator, model_validator
from sqlalchemy import select

from model.errors import InvalidInputError, ModelError
from model.plant import TargetPlane
from service import models, store
from service.faults import ConflictError, ServiceError
from service.runtime import Runtime
from service.schemas import Method, Model, ModelVersion, Moment, Name, Plane, Position, Resolution, Sun
from service.studies import StudyRequest, Surfaces, study_row, study_store
from service.tables import HeliostatRow
from service.workers import Context, Kind, Kinds, Result
from service.workflows import ForecastRequest, Traced, plane_as_json, predict_surface, trace_request

Heliostats = Annotated[
    list[Name] | None, Field(min_length=1, max_length=20_000, description="Names of heliostats; all without it.")
]
# What one heliostat may lack without ending the work on the others.
_SKIPPED = (ModelError, ServiceError)


def _names(runtime: Runtime, wanted: Sequence[str] | None) -> list[str]:
    """The heliostats that are wanted, each once; all of the store where none is named."""
    if wanted is not None:
        return list(dict.fromkeys(wanted))
    with runtime.database.reading() as session:
        return list(session.scalars(select(HeliostatRow.name).order_by(HeliostatRow.name)))


def _require_some(done: int, skipped: dict[str, str]) -> None:
    """ConflictError where nothing could be done, with the first reason."""
    if not done:
        name, reason = next(iter(skipped.items()), ("the store", "it holds no heliostat"))
        raise ConflictError(f"nothing could be done for any of {len(skipped)} heliostats; {name}: {reason}")


# --- surfaces of many heliostats --------------------------------------------------------------------------------------


class PredictionsIn(Model):
    """Predict the surfaces of many heliostats, each from its newest accepted measurements."""

    heliostats: Heliostats = None
    method: Method = Field(default="network", description="network: at once; refined: fitted through the ray tracer.")
    images: int = Field(default=8, ge=1, le=8, description="How many measurements to take of each heliostat.")
    model_version: ModelVersion = None


def predict_many(context: Context, payload: PredictionsIn) -> Result:
    """A new surface version for each heliostat, once each however often the job is begun."""
    names, done = _names(context.runtime, payload.heliostats), context.steps()
    version = _model_number(context.runtime, payload.model_version)
    for index, name in enumerate(names):
        context.report(index / len(names), name)
        if name not in done:
            _predict_step(context, payload, name, version)
    steps = context.steps()
    skipped = {name: step["skipped"] for name, step in steps.items() if "skipped" in step}
    versions = {name: step["version"] for name, step in steps.items() if "version" in step}
    _require_some(len(versions), skipped)
    return Result({"surfaces": versions, "skipped": skipped})


def _model_number(runtime: Runtime, wanted: int | None) -> int:
    """The version of the plant's model that is wanted, or the current one: the same for all heliostats of a job."""
    with runtime.database.reading() as session:
        return models.get_model(session, wanted).number


def _predict_step(context: Context, payload: PredictionsIn, name: str, model_version: int) -> None:
    try:
        predict_surface(
            context.runtime,
            name,
            payload.method,
            images=payload.images,
            actor=context.created_by,
            also=lambda session, row: context.keep(session, name, {"version": row.version}),
            model_version=model_version,
        )
    except _SKIPPED as error:
        with context.runtime.database.writing() as session:
            context.keep(session, name, {"skipped": str(error)})


# --- the flux of many heliostats --------------------------------------------------------------------------------------


class FleetForecastIn(Model):
    """Superpose the flux of many heliostats on one plane."""

    heliostats: Heliostats = None
    target: Name | None = Field(default=None, description="A stored target; either this or `plane`.")
    plane: Plane | None = Field(default=None, description="Any plane; either this or `target`.")
    sun: Sun
    aim_point: Position | None = Field(
        default=None, description="Where all heliostats aim [m]; by default the plane's centre."
    )
    surface: Literal["current", "ideal"] = Field(
        default="current", description="The heliostats' current surfaces, where one has none it is skipped; or ideal."
    )
    dni_w_m2: float = Field(default=1000.0, gt=0, le=2000, description="Direct normal irradiance [W/m2].")
    resolution: Resolution = (256, 256)
    model_version: ModelVersion = None

    @model_validator(mode="after")
    def _one(self) -> Self:
        if (self.target is None) == (self.plane is None):
            raise ValueError("give either target or plane")
        return self

    def request(self, name: str, model_version: int) -> ForecastRequest:
        """The same for one heliostat."""
        return ForecastRequest(
            heliostat=name,
            sun_azimuth_deg=self.sun.azimuth_deg,
            sun_elevation_deg=self.sun.elevation_deg,
            target=self.target,
            plane=None if self.plane is None else self.plane.named("plane"),
            aim=self.aim_point,
            surface=self.surface,
            dni=self.dni_w_m2,
            resolution=self.resolution,
            model_version=model_version,
        )


def forecast_fleet(context: Context, payload: FleetForecastIn) -> Result:
    """The sum of the heliostats' flux maps [W/m2]; nobody's light is blocked by a neighbour."""
    names = _names(context.runtime, payload.heliostats)
    version = _model_number(context.runtime, payload.model_version)
    flux = np.zeros(payload.resolution)
    skipped: dict[str, str] = {}
    traced: Traced | None = None
    for index, name in enumerate(names):
        context.report(index / len(names), name)
        try:
            traced = trace_request(context.runtime, payload.request(name, version))
            flux += traced.forecast.flux
        except _SKIPPED as error:
            skipped[name] = str(error)
    _require_some(len(names) - len(skipped), skipped)
    assert traced is not None
    figures = _figures(flux, traced.plane) | {"model_version": traced.model.version}
    counts = {"heliostats": len(names) - len(skipped), "skipped": skipped}
    return Result(figures | counts, {"flux": flux.astype(np.float32)})


def _figures(flux: np.ndarray[Any, Any], plane: TargetPlane) -> dict[str, Any]:
    pixel_m2 = plane.width * plane.height / flux.size
    return {
        "peak_w_m2": float(flux.max()),
        "power_w": float(flux.sum() * pixel_m2),
        "plane": plane_as_json(plane),
    }


# --- studies ----------------------------------------------------------------------------------------------------------


class StudyIn(Model):
    """Find the effect that stored photographs demand and the plant's current model lacks."""

    heliostats: list[Name] | None = Field(
        default=None, min_length=1, max_length=200, description="Names of heliostats; else some of all over the field."
    )
    most_heliostats: int = Field(
        default=12, ge=1, le=200, description="How many heliostats to take where none is named, near ones and far ones."
    )
    surfaces: Surfaces = Field(
        default="current",
        description="measured: only heliostats with a measured surface; current: where there is none, the newest "
        "prediction.",
    )
    images: int = Field(
        default=12,
        ge=2,
        le=64,
        description="Most photographs of each heliostat: the newest ones, spread over the sun's positions.",
    )
    since: Moment | None = Field(default=None, description="Only photographs from then on (time with zone).")
    until: Moment | None = Field(default=None, description="Only photographs before then (time with zone).")
    candidates: list[str] | None = Field(
        default=None, min_length=1, max_length=100, description="Names of the effects to try; all without it."
    )

    @field_validator("candidates")
    @classmethod
    def _known(cls, names: list[str] | None) -> list[str] | None:
        from model.effects import CATALOGUE  # late: it brings the tracer's libraries with it

        if names is not None and not set(names) <= set(CATALOGUE):
            raise ValueError(f"the catalogue of effects has {', '.join(CATALOGUE)}")
        return None if names is None else list(dict.fromkeys(names))


def make_study(context: Context, payload: StudyIn) -> Result:
    """A study, stored once however often the job is begun."""
    if "study" not in context.steps():
        studied = study_store(context.runtime, StudyRequest(**payload.model_dump()), context.report)
        options = payload.model_dump(mode="json")
        row = study_row(studied, f"Study of job {context.lease.job_id}", options, context.created_by)
        with context.runtime.database.writing() as session:
            store.add_study(session, row)
            about = {"study": row.id, "verdict": row.verdict, "conclusion": row.conclusion, "skipped": row.skipped}
            context.keep(session, "study", about)
    return Result(context.steps()["study"])


# --- a measurement folder ---------------------------------------------------------------------------------------------


class ImportIn(Model):
    """Load a measurement folder that lies on the service's machine, under the folder that its operator allowed."""

    folder: str = Field(
        min_length=1,
        max_length=500,
        pattern=r"^[^\x00-\x1f\x7f]+$",
        description="Path relative to the allowed folder; `.` is that folder itself.",
        examples=["stj"],
    )


def allowed_folder(root: Path | None, folder: str) -> Path:
    """The folder of this name under ``root``; nothing that a link or a ``..`` leads to outside of it.

    Raises
    ------
    ConflictError
        Where the operator allowed no folder.
    InvalidInputError
        Where it is none, leads outside, or holds a link that does.
    """
    if root is None:
        raise ConflictError("no folder may be imported: the operator sets HELIOTWIN_IMPORT_ROOT first")
    top = root.resolve()
    path = (top / folder).resolve()
    # The answer is the same for what does not exist and what lies outside: it tells nothing of the rest of the disk.
    if not path.is_relative_to(top) or not path.is_dir():
        raise InvalidInputError(f"folder: there is no folder {folder!r} under the one that may be imported")
    for entry in path.rglob("*"):
        if entry.is_symlink() and not entry.resolve().is_relative_to(top):
            raise InvalidInputError(f"folder: {entry.relative_to(top)} leads outside; copy what it links to")
    return path


def import_allowed(context: Context, payload: ImportIn) -> Result:
    """The plant, heliostats, images and measured surfaces of a folder; what is there already stays as it is."""
    from service.importer import import_folder
    from service.paint import read_folder

    folder = read_folder(allowed_folder(context.runtime.settings.import_root, payload.folder))
    images = [len(item.images) for name in folder.plant.heliostats for item in folder.measurements(name, False)]
    return Result(import_folder(context.runtime, folder, _steps(context, len(folder.plant.heliostats) + sum(images))))


def _steps(context: Context, total: int) -> Callable[[str], None]:
    """What reports the names of what is done one after the other as a share of ``total``."""
    seen: list[str] = []

    def step(name: str) -> None:
        context.report(len(seen) / max(total, 1), name)
        seen.append(name)

    return step


KINDS: Kinds = {
    kind.name: kind
    for kind in (
        Kind("predictions", PredictionsIn, predict_many, "Predict the surfaces of many heliostats."),
        Kind("forecasts", FleetForecastIn, forecast_fleet, "Superpose the flux of many heliostats on one plane."),
        Kind("studies", StudyIn, make_study, "Find the effect that photographs demand and the model lacks."),
        Kind("imports", ImportIn, import_allowed, "Load a measurement folder into the store."),
    )
}
"""Every kind of job by its name."""
