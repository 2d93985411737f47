"""Surfaces by version, which of them is active, and the forms that decide."""

from collections.abc import Iterator
from datetime import datetime
from functools import partial
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Body, Depends, Form, Path, Query, Response, status
from pydantic import BaseModel, Field
from sqlalchemy.orm import Session

from service import store
from service.base.arrays import unpack
from service.base.fields import (
    Author,
    CreatedAt,
    HeliostatOf,
    Id,
    MeasurementName,
    Method,
    Model,
    ModelNumber,
    ModelVersion,
    Moment,
    ReadVersion,
    Reason,
    Source,
    SurfaceSource,
    SurfaceVersion,
    Text,
    Version,
    VersionIn,
    Whole,
    Why,
    from_row,
)
from service.drawing.pictures import surface_picture
from service.store import decisions
from service.store.listing import Order, Period
from service.store.surface_versions import SurfaceFilter
from service.store.tables import DecisionRow, HeliostatRow, SurfaceRow
from service.twin.alarms import acknowledging
from service.twin.alarms.field_overview import field_totals
from service.twin.runtime import Runtime
from service.twin.stored_mount import facet_places
from service.twin.surfaces.evaluation import justify_by_hand
from service.twin.surfaces.prediction import predict_surface
from service.web.auth.dependencies import (
    COMPUTE_SLOT,
    OPERATE,
    OVERVIEW_SLOT,
    READ,
    RENDER_SLOT,
    IdentityDep,
    IfMatch,
    Limit,
    NamePath,
    RuntimeDep,
    require_json,
    set_tag,
)
from service.web.responses import formats
from service.web.responses.formats import MediaType, json_answer, maps_answer
from service.web.responses.lists import AfterId, OrderQuery, Page, page, sheet_answer
from service.web.responses.openapi import arrays, problems
from service.web.responses.pages import go_to
from service.web.responses.representations import Maps


class SurfaceIn(Model):
    """How to predict a surface. Without ``measurements`` the newest accepted ones are used."""

    method: Method = Field(
        default="network",
        description=(
            "network: at once, if one was trained for the mirror; otherwise as refined. refined:"
            " fitted through the ray tracer, which takes up to minutes."
        ),
    )
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
        description=(
            "How many of the newest accepted ones to take, spread over the sun's positions; 8 the"
            " network."
        ),
    )
    model_version: ModelVersion = None


class SurfaceSummary(BaseModel):
    """A version of a surface."""

    heliostat: HeliostatOf
    version: SurfaceVersion
    source: SurfaceSource
    model: str | None = Field(description="Name and hash of the network's weights.")
    model_version: ModelNumber | None = Field(
        description="Version of the plant's model that it was predicted by; null: it was measured."
    )
    created_at: CreatedAt
    valid_from: datetime | None = Field(
        description=(
            "The mirror is taken to have this surface from then on; null: since when is not known."
        )
    )
    epoch_since: datetime | None = Field(
        description=(
            "When the epoch of the mirror began that it describes: photographs from before show"
            " another shape; null: the mirror never changed."
        )
    )
    measurements: list[str] = Field(description="Ids of the measurements that it was made from.")
    outdated: list[str] = Field(
        description="Ids of those of them that were corrected or excluded since."
    )
    deleted: list[str] = Field(
        description="Photographs that it was made from, too, and that were deleted since."
    )
    misfit: float | None = Field(description="Share of the flux that it leaves unexplained [1].")
    trusted: bool | None = Field(
        description=(
            "Whether it explains all its photographs by a mirror like those known; null: it was not"
            " predicted."
        )
    )
    warnings: list[str] | None = Field(description="Why it is not trusted, in sentences.")
    warned_since: datetime | None = Field(
        description="Since when the heliostat's predictions have not been trusted."
    )
    suspicious: list[str] | None = Field(
        description="Ids of the measurements that it does not explain."
    )
    mahalanobis_distance: float | None = Field(
        description=(
            "Distance from the mirrors known, in standard deviations per root degree of freedom"
            " [1]; about 1."
        )
    )
    sun_span_deg: float | None = Field(
        description=(
            "What its photographs cover: the largest angle between their suns [deg]; 0 for a single"
            " sun."
        )
    )
    acknowledged_at: datetime | None = Field(description="When the warnings were acknowledged.")
    acknowledged_by: str | None = Field(description="Who.")
    is_candidate: bool = Field(
        description="Whether it is never current, because another version was judged or chosen."
    )


class ChoiceIn(Model):
    """The version to make the active surface."""

    version: VersionIn = Field(description="Version of the surface.")
    reason: Reason = Field(description="Why; kept with the decision.")


class SurfaceAcknowledgementIn(Model):
    """Why the warnings of a surface are acknowledged."""

    reason: Annotated[Reason, Field(description="Why they are acknowledged.")]


class DecisionOut(BaseModel):
    """A decision that made a version the active surface or a candidate, with its reasons."""

    id: Id
    version: SurfaceVersion
    became_active: bool = Field(
        description="Whether it became the active surface; else it is a candidate."
    )
    previous: int | None = Field(description="The version that was active until then.")
    created_at: CreatedAt
    created_by: Author
    reason: Why
    accuracy_before: float | None = Field(
        description="Mean flux accuracy of the former one [1]; null: not compared."
    )
    accuracy_after: float | None = Field(description="The same of this one [1].")
    photographs: int = Field(description="On how many photographs.")


def decision_out(row: DecisionRow) -> DecisionOut:
    """A decision as JSON."""
    return from_row(DecisionOut, row, version=row.surface.version)


class SurfaceOut(SurfaceSummary):
    """A surface with its arrays."""

    z: list[Any] = Field(
        description=(
            "Control heights (4, 8, 8) [m]: facet, along x, along y; deviation from the ideally"
            " canted facet."
        )
    )
    z_std: list[Any] = Field(description="Their standard deviations (4, 8, 8) [m].")
    control_points: list[Any] = Field(description="(4, 8, 8, 3) [m] in heliostat coordinates.")


def surface_summary(heliostat_name: str, row: SurfaceRow) -> SurfaceSummary:
    """A surface without its arrays."""
    return from_row(
        SurfaceSummary,
        row,
        heliostat=heliostat_name,
        measurements=[measurement.identifier for measurement in row.measurements],
        outdated=[measurement.identifier for measurement in row.outdated],
        deleted=row.deleted or [],
    )


def surface_out(heliostat_name: str, row: SurfaceRow) -> SurfaceOut:
    """A surface with its arrays as JSON."""
    arrays = {name: array.tolist() for name, array in unpack(row.arrays).items()}
    return SurfaceOut.model_validate(
        {**surface_summary(heliostat_name, row).model_dump(), **arrays}
    )


def surface_answer(
    runtime: Runtime, heliostat: HeliostatRow, row: SurfaceRow, media_type: str
) -> Response:
    """A surface in the requested media type."""
    arrays = unpack(row.arrays)
    if media_type == formats.JSON:
        return json_answer(surface_summary(heliostat.name, row), **arrays)
    name, title = (
        f"{heliostat.name}-surface-{row.version}",
        f"{heliostat.name}, surface {row.version} ({row.source})",
    )
    with runtime.database.reading() as session:
        places = facet_places(heliostat, store.get_plant(session).origin, len(arrays["z"]))
    bound = runtime.settings.figure_scales["heights"]
    picture = partial(surface_picture, arrays["z"], bound=bound, places=places)
    return maps_answer(Maps(name, title, arrays, picture, row.arrays), media_type)


router = APIRouter(prefix="/heliostats/{name}/surfaces", tags=["surfaces"])
pages = APIRouter(include_in_schema=False)

VersionPath = Annotated[Version, Path(description="Number of the version, from 1.")]


@router.post(
    "",
    status_code=status.HTTP_201_CREATED,
    responses={
        **problems(404, 409, 413, 415),
        200: {
            "model": SurfaceOut,
            "description": "Nothing was new; this version is what it would be.",
        },
    },
    dependencies=[OPERATE, Depends(require_json), COMPUTE_SLOT],
)
def post_surface(
    name: NamePath,
    runtime: RuntimeDep,
    identity: IdentityDep,
    response: Response,
    request: SurfaceIn,
) -> SurfaceOut:
    """Predict the surface of a heliostat from its photographs.

    It is stored as the next version. If there is an active surface already, the new one replaces it
    if it forecasts photographs no worse. Otherwise it becomes a candidate (`is_candidate`).
    `decisions` has the figures, and `PUT .../current` changes the decision.
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
    responses={
        **problems(404, 406),
        **arrays(Page[SurfaceSummary] | SurfaceOut, "With `at`: the surface itself."),
    },
    response_model=None,
    dependencies=[READ],
)
def list_surfaces(
    name: NamePath,
    runtime: RuntimeDep,
    media_type: MediaType,
    limit: Limit = 100,
    after: Annotated[
        Version | None, Query(description="The last version of the page before.")
    ] = None,
    at: Annotated[
        Moment | None,
        Query(description="Answer with the surface that was valid then (time with zone)."),
    ] = None,
    source: Annotated[Source | None, Query(description="Only those of this source.")] = None,
    trusted: Annotated[
        bool | None, Query(description="Only trusted ones, or only those that are not.")
    ] = None,
    is_candidate: Annotated[
        bool | None, Query(description="Only candidates, or only those that are not.")
    ] = None,
    since: Annotated[
        Moment | None, Query(description="Only those valid from then on (time with zone).")
    ] = None,
    until: Annotated[
        Moment | None, Query(description="Only those valid from before then (time with zone).")
    ] = None,
    sort: Annotated[
        Literal["version", "valid_from"], Query(description="By version, or by when it is valid.")
    ] = "version",
    order: OrderQuery = "up",
) -> Page[SurfaceSummary] | Response:
    """List the surfaces of a heliostat, oldest version first.

    With `at`, the response is the version that was valid at that time.
    """
    if at is not None:
        return _at(runtime, name, at, media_type)
    with runtime.database.reading() as session:
        rows = store.list_surfaces(
            session,
            store.get_heliostat(session, name),
            limit + 1,
            after,
            filters=SurfaceFilter(source, trusted, is_candidate, Period(since, until)),
            order=Order("id" if sort == "version" else sort, order == "down"),
        )
    items = [surface_summary(name, row) for row in rows]
    return page(items, limit, "version")


def _at(runtime: Runtime, name: str, moment: datetime | None, media_type: str) -> Response:
    with runtime.database.reading() as session:
        heliostat = store.get_heliostat(session, name)
        row = store.get_surface_at(session, heliostat, moment)
    response = surface_answer(runtime, heliostat, row, media_type)
    set_tag(response, row.version)
    return response


@router.get(
    "/current",
    responses={**problems(404, 406), **arrays(SurfaceOut, "`control_points`, `z`, `z_std` [m].")},
    dependencies=[READ],
)
def get_current_surface(
    name: NamePath,
    runtime: RuntimeDep,
    media_type: MediaType,
    at: Annotated[
        Moment | None, Query(description="The one that was valid then instead (time with zone).")
    ] = None,
) -> Response:
    """Get the surface that is valid now, or was at a time."""
    return _at(runtime, name, at, media_type)


@router.put(
    "/current", responses=problems(404, 413, 415), dependencies=[OPERATE, Depends(require_json)]
)
def put_current_surface(
    name: NamePath,
    runtime: RuntimeDep,
    identity: IdentityDep,
    choice: Annotated[ChoiceIn, Body()],
    active: IfMatch,
) -> DecisionOut:
    """Make a version the active surface. If-Match names the one that was active.

    Both are compared on photographs that neither has seen. Versions with precedence over it become
    candidates.
    """
    return _decide(runtime, name, choice, identity.name, active)


def _decide(
    runtime: Runtime,
    name: str,
    choice: ChoiceIn,
    actor: str,
    active: int | None,
    became_active: bool = True,
) -> DecisionOut:
    grounds = justify_by_hand(runtime, name, choice.version, choice.reason)
    return runtime.database.run_in_transaction(
        lambda session: decision_out(
            decisions.decide(session, name, choice.version, became_active, actor, grounds, active)
        )
    )


@router.post("/undo", responses=problems(404, 409), dependencies=[OPERATE])
def undo_decision(
    name: NamePath, runtime: RuntimeDep, identity: IdentityDep, active: IfMatch
) -> DecisionOut:
    """Undo the last decision about the active surface. The previous one is active again.

    If-Match names the surface that was active, so that only one of two simultaneous undos succeeds.
    """
    return _undo(runtime, name, identity.name, shown=active)


def _undo(runtime: Runtime, name: str, actor: str, **expected: int | None) -> DecisionOut:
    def undo(session: Session) -> DecisionOut:
        heliostat = store.get_heliostat(session, name)
        return decision_out(decisions.undo_decision(session, heliostat, actor, **expected))

    return runtime.database.run_in_transaction(undo)


@router.get("/decisions", responses=problems(404), dependencies=[READ])
def list_decisions(
    name: NamePath, runtime: RuntimeDep, limit: Limit = 100, after: AfterId = None
) -> Page[DecisionOut]:
    """List the decisions about the active surface, newest first."""
    with runtime.database.reading() as session:
        rows = decisions.list_decisions(
            session, store.get_heliostat(session, name), limit + 1, after
        )
    return page([decision_out(row) for row in rows], limit)


@router.get(
    "/{version}",
    responses={**problems(404, 406), **arrays(SurfaceOut, "`control_points`, `z`, `z_std` [m].")},
    dependencies=[READ],
)
def get_surface(
    name: NamePath, version: VersionPath, runtime: RuntimeDep, media_type: MediaType
) -> Response:
    """Get a version of the surface."""
    with runtime.database.reading() as session:
        heliostat = store.get_heliostat(session, name)
        row = store.get_surface(session, heliostat, version)
    return surface_answer(runtime, heliostat, row, media_type)


@router.post(
    "/{version}/acknowledge",
    responses=problems(404, 409, 413, 415),
    dependencies=[OPERATE, OVERVIEW_SLOT, Depends(require_json)],
)
def acknowledge_surface(
    name: NamePath,
    version: VersionPath,
    runtime: RuntimeDep,
    identity: IdentityDep,
    body: Annotated[SurfaceAcknowledgementIn, Body()],
) -> SurfaceSummary:
    """Acknowledge that the active surface is not trusted, as its alarm.

    The answer is 409 if it is trusted. `POST /v1/alarms/acknowledgements/{number}/undo` undoes
    it.
    """
    acknowledging.acknowledge_surface(runtime, name, version, identity.name, body.reason)
    with runtime.database.reading() as session:
        row = store.get_surface(session, store.get_heliostat(session, name), version)
        return surface_summary(name, row)


# --- forms and the table
# --------------------------------------------------------------------------------------------------


class DecisionUndoForm(Model):
    """The button that undoes a decision; without its number, the last one."""

    decision: ReadVersion = None


@pages.post("/heliostats/{name}/surfaces/undo", dependencies=[OPERATE])
def post_undo_form(
    name: NamePath,
    form: Annotated[DecisionUndoForm, Form()],
    runtime: RuntimeDep,
    identity: IdentityDep,
) -> Response:
    """Undo the last decision."""
    _undo(runtime, name, identity.name, decision=form.decision)
    return go_to(f"/heliostats/{name}#history-title")


@pages.post(
    "/heliostats/{name}/surfaces/{version}/acknowledge", dependencies=[OPERATE, OVERVIEW_SLOT]
)
def post_acknowledge_form(
    name: NamePath,
    version: VersionPath,
    form: Annotated[SurfaceAcknowledgementIn, Form()],
    runtime: RuntimeDep,
    identity: IdentityDep,
) -> Response:
    """Acknowledge that a surface is not trusted, as its alarm."""
    acknowledge_surface(name, version, runtime, identity, form)
    return go_to(f"/heliostats/{name}#warnings-title")


class TakeForm(Model):
    """The button, with an optional reason, and the version that was active; 0 for none."""

    reason: Annotated[Text, Field(max_length=200)] = ""
    active: ReadVersion = None


# After the form of an acknowledgement: this path would match its path, too.
@pages.post("/heliostats/{name}/surfaces/{version}/{verb}", dependencies=[OPERATE])
def post_decision_form(
    name: NamePath,
    version: VersionPath,
    verb: Literal["take", "keep"],
    form: Annotated[TakeForm, Form()],
    runtime: RuntimeDep,
    identity: IdentityDep,
) -> Response:
    """Make a version the active surface, or keep the active one instead of it."""
    is_taken = verb == "take"
    said = f"{identity.name} {'chose it' if is_taken else 'kept the active surface'}"
    choice = ChoiceIn(version=version, reason=form.reason or said)
    _decide(runtime, name, choice, identity.name, form.active, became_active=is_taken)
    return go_to(f"/heliostats/{name}#history-title")


_SURFACE = (
    "version",
    "source",
    "is_active",
    "is_candidate",
    "valid_from",
    "created_at",
    "deviation_mm",
    "uncertainty_mm",
    "misfit",
    "trusted",
    "warnings",
    "photographs",
    "model",
    "model_version",
)


def surface_rows(runtime: Runtime, name: str) -> Iterator[list[object]]:
    """All versions of a heliostat's surface as rows of CSV, oldest first."""
    with runtime.database.reading() as session:
        heliostat = store.get_heliostat(session, name)
        today = store.find_surface_at(session, heliostat)
        rows = store.list_surfaces(session, heliostat, None, arrays=True)
    for row in rows:
        figures = field_totals(row.arrays)
        made = {
            "is_active": today is not None and row.id == today.id,
            "deviation_mm": figures.deviation_mm,
            "uncertainty_mm": figures.uncertainty_mm,
            "warnings": "; ".join(row.warnings or []),
            "photographs": " ".join(one.identifier for one in row.measurements),
            "model_version": row.model_version and int(row.model_version.partition(":")[0]),
        }
        yield [made[name] if name in made else getattr(row, name) for name in _SURFACE]


@pages.get("/heliostats/{name}/surfaces.csv", dependencies=[READ, RENDER_SLOT])
def get_surfaces_table(name: NamePath, runtime: RuntimeDep) -> Response:
    """All versions of a heliostat's surface, oldest first."""
    return sheet_answer(f"{name}-surfaces", _SURFACE, surface_rows(runtime, name))
