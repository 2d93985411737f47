"""Surfaces by version."""

from datetime import datetime
from functools import partial
from typing import Annotated, Any

from fastapi import APIRouter, Body, Depends, Path, Query, Response, status
from pydantic import BaseModel, Field

from service import store
from service.base.arrays import unpack
from service.base.fields import MeasurementName, Method, Model, ModelVersion, Moment, Source, Version, VersionIn, Whole
from service.base.settings import Settings
from service.drawing.pictures import surface_picture
from service.store import decisions
from service.store.decisions import Grounds
from service.store.tables import DecisionRow, SurfaceRow
from service.twin.prediction import predict_surface
from service.twin.runtime import Runtime
from service.web.answers import formats
from service.web.answers.formats import MediaType, json_answer, maps_answer
from service.web.answers.openapi import arrays, problems
from service.web.answers.paging import Page, page
from service.web.answers.representation import Maps
from service.web.door.dependencies import (
    COMPUTES,
    OPERATE,
    READ,
    IdentityDep,
    Limit,
    NamePath,
    RuntimeDep,
    require_json,
)


class SurfaceIn(Model):
    """How to predict a surface; without ``measurements`` the newest accepted ones are chosen."""

    method: Method = Field(default="network", description="network: at once; refined: fitted through the ray tracer.")
    measurements: list[MeasurementName] | None = Field(
        default=None,
        min_length=1,
        max_length=64,
        description="Ids of accepted measurements: 1 to 8 for the network, to 64 refined.",
    )
    images: Whole = Field(
        default=8,
        ge=1,
        le=64,
        description="How many of the newest accepted ones to take, spread over the sun's positions; 8 the network.",
    )
    model_version: ModelVersion = None


class SurfaceSummary(BaseModel):
    """A version of a surface."""

    heliostat: str
    version: int
    source: Source
    model: str | None = Field(description="Name and hash of the network's weights.")
    model_version: str | None = Field(
        description="Version of the plant's model that it was predicted by; null: it was measured."
    )
    created_at: datetime
    valid_from: datetime = Field(description="The mirror is taken to have this surface from then on.")
    measurements: list[str] = Field(description="Ids of the measurements that it was made from.")
    outdated: list[str] = Field(description="Ids of those of them that were corrected or excluded since.")
    misfit: float | None = Field(description="What the refinement left unexplained of the flux.")
    trusted: bool | None = Field(
        description="Whether it explains all its photographs by a mirror like those known; null: it was not predicted."
    )
    doubts: list[str] | None = Field(description="Why it is not trusted, in sentences.")
    doubted_since: datetime | None = Field(description="Since when the heliostat's predictions have not been trusted.")
    suspicious: list[str] | None = Field(description="Ids of the measurements that it does not explain.")
    strangeness: float | None = Field(
        description="Distance from the mirrors known, in standard deviations per root degree of freedom [1]; about 1."
    )
    sun_span_deg: float | None = Field(
        description="What its photographs cover: the largest angle between their suns [deg]; 0 for a single sun."
    )
    seen_at: datetime | None = Field(description="Since when somebody has seen the doubts.")
    seen_by: str | None = Field(description="Who.")
    set_aside: bool = Field(description="Whether it is never current, because another version was judged or chosen.")


class ChoiceIn(Model):
    """Which version is today's from now on."""

    version: VersionIn
    reason: str = Field(min_length=1, max_length=200, description="Why; kept with the decision.")


class DecisionOut(BaseModel):
    """That a version became today's surface, or was set aside, and on what grounds."""

    version: int
    taken: bool = Field(description="Whether it became today's; else it was set aside.")
    previous: int | None = Field(description="The version that was today's until then.")
    made_at: datetime
    made_by: str
    reason: str
    accuracy_before: float | None = Field(description="Mean flux accuracy of the former one [1]; null: not compared.")
    accuracy_after: float | None = Field(description="The same of this one [1].")
    photographs: int = Field(description="On how many photographs.")


def decision_out(row: DecisionRow) -> DecisionOut:
    """A decision as JSON."""
    names = set(DecisionOut.model_fields) - {"version"}
    return DecisionOut(version=row.surface.version, **{name: getattr(row, name) for name in names})


class SurfaceOut(SurfaceSummary):
    """A surface with its arrays."""

    z: list[Any] = Field(
        description="Control heights (4, 8, 8) [m]: facet, along x, along y; deviation from the ideally canted facet."
    )
    z_std: list[Any] = Field(description="Their standard deviations (4, 8, 8) [m].")
    control_points: list[Any] = Field(description="(4, 8, 8, 3) [m] in heliostat coordinates.")


_TOLD = (
    "trusted",
    "doubts",
    "doubted_since",
    "suspicious",
    "strangeness",
    "sun_span_deg",
    "seen_at",
    "seen_by",
)


def surface_summary(heliostat_name: str, row: SurfaceRow) -> SurfaceSummary:
    """A surface without its arrays."""
    return SurfaceSummary.model_validate(
        {
            "heliostat": heliostat_name,
            "version": row.version,
            "source": row.source,
            "model": row.model,
            "model_version": row.model_version,
            "created_at": row.created_at,
            "valid_from": row.valid_from,
            "measurements": [measurement_out.identifier for measurement_out in row.measurements],
            "outdated": [measurement_out.identifier for measurement_out in row.outdated],
            "misfit": row.misfit,
            **{name: getattr(row, name) for name in _TOLD},
            "set_aside": row.set_aside,
        }
    )


def surface_out(heliostat_name: str, row: SurfaceRow) -> SurfaceOut:
    """A surface with its arrays as JSON."""
    arrays = {name: array.tolist() for name, array in unpack(row.arrays).items()}
    return SurfaceOut.model_validate({**surface_summary(heliostat_name, row).model_dump(), **arrays})


def surface_answer(heliostat_name: str, row: SurfaceRow, media_type: str, settings: Settings) -> Response:
    """A surface as the client wants it."""
    arrays = unpack(row.arrays)
    if media_type == formats.JSON:
        return json_answer(surface_summary(heliostat_name, row), **arrays)
    name, title = f"{heliostat_name}-surface-{row.version}", f"{heliostat_name}, surface {row.version} ({row.source})"
    picture = partial(surface_picture, arrays["z"], bound=settings.figure_scales["heights"])
    return maps_answer(Maps(name, title, arrays, picture, row.arrays), media_type)


router = APIRouter(prefix="/heliostats/{name}/surfaces", tags=["surfaces"])


@router.post(
    "",
    status_code=status.HTTP_201_CREATED,
    responses={
        **problems(404, 409, 413, 415),
        200: {"model": SurfaceOut, "description": "Nothing was new; this version is what it would be."},
    },
    dependencies=[OPERATE, Depends(require_json), COMPUTES],
)
def post_surface(
    name: NamePath,
    runtime: RuntimeDep,
    identity: IdentityDep,
    response: Response,
    request: Annotated[SurfaceIn, Body(examples=[{"method": "network", "images": 4}])],
) -> SurfaceOut:
    """Predict the surface from stored measurements and keep it as the next version.

    Where there is one of today already, the new one takes its place if it forecasts photographs no worse, and is
    `set_aside` otherwise: `decisions` has the figures, and `PUT .../current` decides otherwise.
    """
    kept = predict_surface(
        runtime,
        name,
        request.method,
        request.measurements,
        request.images,
        identity.name,
        model_version=request.model_version,
    )
    response.headers["Location"] = f"/v1/heliostats/{name}/surfaces/{kept.row.version}"
    if not kept.is_new:
        response.status_code = status.HTTP_200_OK
    return surface_out(name, kept.row)


@router.get(
    "",
    responses={**problems(404, 406), **arrays(Page[SurfaceSummary] | SurfaceOut, "With `at`: the surface itself.")},
    response_model=None,
    dependencies=[READ],
)
def list_surfaces(
    name: NamePath,
    runtime: RuntimeDep,
    media_type: MediaType,
    limit: Limit = 100,
    after: Annotated[Version | None, Query(description="The last version of the page before.")] = None,
    at: Annotated[
        Moment | None, Query(description="Answer with the surface that was valid then (time with zone).")
    ] = None,
) -> Page[SurfaceSummary] | Response:
    """The history of the surface, oldest version first; with `at` the one that was valid at that time."""
    if at is not None:
        return _at(runtime, name, at, media_type)
    with runtime.database.reading() as session:
        rows = store.list_surfaces(session, store.get_heliostat(session, name), limit + 1, after)
    items = [surface_summary(name, row) for row in rows]
    return page(items, limit, "version")


def _at(runtime: Runtime, name: str, moment: datetime | None, media_type: str) -> Response:
    with runtime.database.reading() as session:
        row = store.get_surface_at(session, store.get_heliostat(session, name), moment)
    return surface_answer(name, row, media_type, runtime.settings)


@router.get(
    "/current",
    responses={**problems(404, 406), **arrays(SurfaceOut, "`control_points`, `z`, `z_std` [m].")},
    dependencies=[READ],
)
def get_current_surface(
    name: NamePath,
    runtime: RuntimeDep,
    media_type: MediaType,
    at: Annotated[Moment | None, Query(description="The one that was valid then instead (time with zone).")] = None,
) -> Response:
    """The surface that is valid now, or was at a time."""
    return _at(runtime, name, at, media_type)


@router.put("/current", responses=problems(404, 413, 415), dependencies=[OPERATE, Depends(require_json)])
def put_current_surface(
    name: NamePath, runtime: RuntimeDep, identity: IdentityDep, choice: Annotated[ChoiceIn, Body()]
) -> DecisionOut:
    """Make a version today's, whatever was judged; versions that would go before it are set aside."""
    with runtime.database.writing() as session:
        heliostat = store.get_heliostat(session, name)
        surface = store.get_surface(session, heliostat, choice.version)
        return decision_out(decisions.take(session, heliostat, surface, identity.name, Grounds(choice.reason)))


@router.post("/undo", responses=problems(404, 409), dependencies=[OPERATE])
def undo_decision(name: NamePath, runtime: RuntimeDep, identity: IdentityDep) -> DecisionOut:
    """Take back the last decision that changed today's surface: the one before it is so again."""
    with runtime.database.writing() as session:
        return decision_out(decisions.undo(session, store.get_heliostat(session, name), identity.name))


@router.get("/decisions", responses=problems(404), dependencies=[READ])
def list_decisions(name: NamePath, runtime: RuntimeDep, limit: Limit = 100) -> list[DecisionOut]:
    """Which versions became today's or were set aside, the last decision first."""
    with runtime.database.reading() as session:
        rows = decisions.list_decisions(session, store.get_heliostat(session, name), limit)
    return [decision_out(row) for row in rows]


@router.get(
    "/{version}",
    responses={**problems(404, 406), **arrays(SurfaceOut, "`control_points`, `z`, `z_std` [m].")},
    dependencies=[READ],
)
def get_surface(
    name: NamePath,
    version: Annotated[Version, Path(description="Number of the version, from 1.")],
    runtime: RuntimeDep,
    media_type: MediaType,
) -> Response:
    """A version of the surface."""
    with runtime.database.reading() as session:
        row = store.get_surface(session, store.get_heliostat(session, name), version)
    return surface_answer(name, row, media_type, runtime.settings)


@router.post("/{version}/seen", responses=problems(404, 409), dependencies=[OPERATE])
def see_surface(
    name: NamePath,
    version: Annotated[Version, Path(description="Number of the version, from 1.")],
    runtime: RuntimeDep,
    identity: IdentityDep,
) -> SurfaceSummary:
    """Note that somebody has seen that a surface is not trusted, and why; 409 where it is."""
    with runtime.database.writing() as session:
        heliostat = store.get_heliostat(session, name)
        row = store.get_surface(session, heliostat, version)
        decisions.see(session, heliostat, row, identity.name)
        return surface_summary(name, row)
