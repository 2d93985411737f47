"""The kinds of job: what each takes, and the plain function that does it.

A new kind is its payload, its function and one line in `KINDS`; its route, its documentation and the workers follow.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, field_validator, model_validator
from sqlalchemy import select
from sqlalchemy.orm import Session

from model.errors import InvalidInputError
from model.frames import sun_direction
from model.plant import Receiver
from service import models, store
from service.faults import SKIPPED, ConflictError
from service.progress import Steps
from service.runtime import Runtime
from service.schemas import Method, Model, ModelVersion, Moment, Name, Plane, Position, ReceiverIn, Resolution, Sun
from service.studies import StudyRequest, Surfaces, study_row, study_store
from service.tables import HeliostatRow
from service.workers import Context, Kind, Kinds, Result
from service.workflows import predict_surface, receiver_as_json

Heliostats = Annotated[
    list[Name] | None, Field(min_length=1, max_length=20_000, description="Names of heliostats; all without it.")
]


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
    except SKIPPED as error:
        with context.runtime.database.writing() as session:
            context.keep(session, name, {"skipped": str(error)})


# --- the flux of many heliostats --------------------------------------------------------------------------------------


class FleetForecastIn(Model):
    """Superpose the flux of many heliostats on one receiver: a plane, or a cylinder unrolled.

    It is light in W/m2: effects that the model has of the camera do not act.
    """

    heliostats: Heliostats = None
    target: Name | None = Field(
        default=None, description="A stored target or receiver; either this, `plane` or `receiver`."
    )
    plane: Plane | None = Field(default=None, description="Any plane; either this, `target` or `receiver`.")
    receiver: ReceiverIn | None = Field(default=None, description="Any cylinder; either this, `target` or `plane`.")
    sun: Sun
    aim_point: Position | None = Field(
        default=None, description="Where all heliostats aim [m]; by default the receiver's middle."
    )
    aim_points: dict[Name, Position] = Field(
        default_factory=dict, max_length=20_000, description="Where single heliostats aim instead [m], by name."
    )
    neighbours: bool = Field(
        default=True, description="Whether the mirrors of these heliostats shade and block each other."
    )
    surface: Literal["current", "ideal"] = Field(
        default="current", description="The heliostats' current surfaces, where one has none it is skipped; or ideal."
    )
    dni_w_m2: float = Field(default=1000.0, gt=0, le=2000, description="Direct normal irradiance [W/m2].")
    resolution: Resolution = (256, 256)
    model_version: ModelVersion = None

    @model_validator(mode="after")
    def _one(self) -> Self:
        if sum(value is not None for value in (self.target, self.plane, self.receiver)) != 1:
            raise ValueError("give either target or plane, or receiver")
        return self

    def on(self, session: Session) -> Receiver:
        """What the light falls on."""
        if self.plane is not None:
            return self.plane.named("plane")
        if self.receiver is not None:
            return self.receiver.named("receiver")
        assert self.target is not None  # the schema wants one of the three
        return store.get_target_or_receiver(session, self.target)


def forecast_field(context: Context, payload: FleetForecastIn) -> Result:
    """The sum of the heliostats' flux maps [W/m2]."""
    from service.fleet import Fleet, forecast_fleet  # late: they bring the tracer's libraries with them

    names = _names(context.runtime, payload.heliostats)
    with context.runtime.database.reading() as session:
        receiver, origin = payload.on(session), store.get_plant(session).origin
        model = models.get_model(session, payload.model_version)
    fleet = Fleet(
        names=names,
        receiver=receiver,
        sun=sun_direction(payload.sun.azimuth_deg, payload.sun.elevation_deg),
        optics=replace(model.optics, dni=payload.dni_w_m2),
        model=model,
        origin=origin,
        aim=np.array(receiver.center if payload.aim_point is None else payload.aim_point),
        aims=payload.aim_points,
        ideal=payload.surface == "ideal",
    )
    made = forecast_fleet(context.runtime, fleet, payload.resolution, payload.neighbours, context.report)
    _require_some(made.heliostats, made.skipped)
    figures = _figures(made.irradiance, receiver) | {"model_version": model.version, "reflected_w": made.power}
    counts = {"heliostats": made.heliostats, "skipped": made.skipped}
    return Result(figures | counts, {"flux": made.irradiance.astype(np.float32)})


def _figures(flux: np.ndarray[Any, Any], receiver: Receiver) -> dict[str, Any]:
    pixel_m2 = receiver.width * receiver.height / flux.size
    return {
        "peak_w_m2": float(flux.max()),
        "power_w": float(flux.sum() * pixel_m2),
        "plane": receiver_as_json(receiver),
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
    steps = Steps(len(folder.plant.heliostats) + sum(images), context.report)
    return Result(import_folder(context.runtime, folder, steps))


KINDS: Kinds = {
    kind.name: kind
    for kind in (
        Kind("predictions", PredictionsIn, predict_many, "Predict the surfaces of many heliostats."),
        Kind("forecasts", FleetForecastIn, forecast_field, "Superpose the flux of many heliostats on one receiver."),
        Kind("studies", StudyIn, make_study, "Find the effect that photographs demand and the model lacks."),
        Kind("imports", ImportIn, import_allowed, "Load a measurement folder into the store."),
    )
}
"""Every kind of job by its name."""
