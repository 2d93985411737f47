"""Surfaces by version."""

from datetime import datetime
from typing import Annotated

from fastapi import APIRouter, Body, Depends, Path, Query, Response, status

from service import representations, store
from service.dependencies import OPERATE, READ, IdentityDep, Limit, MediaType, NamePath, RuntimeDep, require_json
from service.openapi import arrays, problems
from service.runtime import Runtime
from service.schemas import Moment, Page, SurfaceIn, SurfaceOut, SurfaceSummary, Version
from service.workflows import predict_surface

router = APIRouter(prefix="/heliostats/{name}/surfaces", tags=["surfaces"])


@router.post(
    "",
    status_code=status.HTTP_201_CREATED,
    responses=problems(404, 409, 413, 415),
    dependencies=[OPERATE, Depends(require_json)],
)
def post_surface(
    name: NamePath,
    runtime: RuntimeDep,
    identity: IdentityDep,
    response: Response,
    request: Annotated[SurfaceIn, Body(examples=[{"method": "network", "images": 4}])],
) -> SurfaceOut:
    """Predict the surface from stored measurements and keep it as the next version."""
    row = predict_surface(
        runtime,
        name,
        request.method,
        request.measurements,
        request.images,
        identity.name,
        model_version=request.model_version,
    )
    response.headers["Location"] = f"/v1/heliostats/{name}/surfaces/{row.version}"
    return representations.surface_full(name, row)


@router.get(
    "",
    responses={**problems(404, 406), **arrays("With `at`: the surface itself.")},
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
    items = [representations.surface_summary(name, row) for row in rows]
    return representations.page(items, limit, "version")


def _at(runtime: Runtime, name: str, moment: datetime | None, media_type: str) -> Response:
    with runtime.database.reading() as session:
        row = store.get_surface_at(session, store.get_heliostat(session, name), moment)
    return representations.surface(name, row, media_type)


@router.get(
    "/current", responses={**problems(404, 406), **arrays("`control_points`, `z`, `z_std` [m].")}, dependencies=[READ]
)
def get_current_surface(name: NamePath, runtime: RuntimeDep, media_type: MediaType) -> Response:
    """The surface that is valid now."""
    return _at(runtime, name, None, media_type)


@router.get(
    "/{version}", responses={**problems(404, 406), **arrays("`control_points`, `z`, `z_std` [m].")}, dependencies=[READ]
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
    return representations.surface(name, row, media_type)
