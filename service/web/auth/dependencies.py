"""Dependencies that routes declare in their signatures.

No dependency holds a database connection. A route opens its session itself and closes it before it
returns. A session from a dependency would keep its connection while the request waits for a thread,
and other threads would wait for that connection.
"""

import json
import re
import threading
from collections.abc import AsyncIterator
from contextlib import AbstractAsyncContextManager
from typing import Annotated, Any

from fastapi import Depends, Header, Path, Query, Request, Response

from model.errors import InvalidInputError
from service.base.errors import UnsupportedContentError
from service.base.fields import MeasurementName, Name, Reason, unique_keys
from service.jobs.kind import Kinds
from service.twin.alarms.field_overview import FieldOverviewCache
from service.twin.forecasts.aims import plant_time_zone
from service.twin.plant_setup import Authorship
from service.twin.runtime import Runtime
from service.twin.surfaces.accuracy import ComparisonCache
from service.web.auth.limiters import FairLimiter
from service.web.auth.security import Identity, Requires, Role, dependencies_of, presented_key


async def get_runtime(request: Request) -> Runtime:
    """The parts of the running service."""
    runtime: Runtime = request.app.state.runtime
    return runtime


RuntimeDep = Annotated[Runtime, Depends(get_runtime)]


def _zone(runtime: RuntimeDep) -> str:
    with runtime.database.reading() as session:
        return plant_time_zone(session, runtime.settings.time_zone)


ZoneDep = Annotated[str, Depends(_zone)]
"""The plant's time zone, which the times of forms are in."""


async def _field(request: Request) -> FieldOverviewCache:
    cache: FieldOverviewCache = request.app.state.field
    return cache


FieldCacheDep = Annotated[FieldOverviewCache, Depends(_field)]
"""The cache of what is computed once for each heliostat of the field."""


async def _comparisons(request: Request) -> ComparisonCache:
    cache: ComparisonCache = request.app.state.comparisons
    return cache


ComparisonCacheDep = Annotated[ComparisonCache, Depends(_comparisons)]
"""The cache of forecasts compared with photographs."""

# For the ``dependencies`` of a route: each requires at least this role.
READ = Depends(Requires(Role.READ))
INGEST = Depends(Requires(Role.INGEST))
OPERATE = Depends(Requires(Role.OPERATE))
ADMIN = Depends(Requires(Role.ADMIN))


async def _identity(request: Request) -> Identity:
    identity: Identity = request.state.identity
    return identity


IdentityDep = Annotated[Identity, Depends(_identity)]
"""The identity that sent the request, for routes that declare `Requires`."""


async def _presented(request: Request) -> str | None:
    return presented_key(request.headers)


PresentedDep = Annotated[str | None, Depends(_presented)]
"""The presented key, for responses that last only while this key is valid."""


async def _stopping(request: Request) -> threading.Event:
    event: threading.Event = request.app.state.stopping
    return event


StoppingDep = Annotated[threading.Event, Depends(_stopping)]
"""Event that is set when the service stops, so that endless responses end."""


async def _kinds(request: Request) -> Kinds:
    kinds: Kinds = request.app.state.kinds
    return kinds


KindsDep = Annotated[Kinds, Depends(_kinds)]
"""The job kinds that this service accepts."""


def render_slot(request: Request) -> AbstractAsyncContextManager[None]:
    """Slot for rendering or serializing large output, for the key that sent the request."""
    return _slot(request, request.app.state.render_limiter)


def _slot(request: Request, limiter: FairLimiter) -> AbstractAsyncContextManager[None]:
    identity: Identity = request.state.identity
    return limiter.acquire(identity.name)


async def _render(request: Request) -> AsyncIterator[None]:
    async with render_slot(request):
        yield


async def _overview(request: Request) -> AsyncIterator[None]:
    async with _slot(request, request.app.state.overview_limiter):
        yield


async def _compute(request: Request) -> AsyncIterator[None]:
    async with _slot(request, request.app.state.compute_limiter):
        yield


# For the ``dependencies`` of a route. The slot is free again before the response is sent, so that a
# slow reader does not block others.
RENDER_SLOT = Depends(_render, scope="function")
"""Slot for drawing maps."""
RenderSlotDep = Annotated[None, RENDER_SLOT]
"""The same slot in a signature, for parameters that follow other dependencies."""
OVERVIEW_SLOT = Depends(_overview, scope="function")
"""Slot for responses about all heliostats."""
COMPUTE_SLOT = Depends(_compute, scope="function")
"""Slot for waiting on the model, so that one key does not fill its queue."""


NamePath = Annotated[Name, Path(description="Name of the heliostat or target.")]
MeasurementPath = Annotated[MeasurementName, Path()]
Limit = Annotated[int, Query(ge=1, le=500, description="Most items on a page.")]


async def _if_match(
    if_match: Annotated[
        str | None,
        Header(
            description=(
                "The ETag of what was read: the answer is 409 if somebody changed the same fields"
                " since, and names who, when and what."
            )
        ),
    ] = None,
) -> int | None:
    if if_match is None or if_match.strip() == "*":
        return None
    found = _TAG.fullmatch(if_match.strip())
    if found is None:
        raise InvalidInputError("If-Match: send the ETag of the answer to GET as it came")
    return int(found[1])


IfMatch = Annotated[int | None, Depends(_if_match)]
"""The version that If-Match names; None without one."""


async def _authorship(
    identity: IdentityDep,
    version: IfMatch,
    reason: Annotated[
        Reason | None,
        Query(description="Why; kept in the audit trail. Needed for a change of what is stored."),
    ] = None,
) -> Authorship:
    return Authorship(identity.name, reason, version)


AuthorshipDep = Annotated[Authorship, Depends(_authorship)]
"""Who changes the plant, why, and since which version nobody else may have changed it."""

_TAG = re.compile(r'"v([0-9]{1,10})"')


def set_tag(response: Response, version: int) -> None:
    """Set the ETag of a version, for `IfMatch`."""
    response.headers["ETag"] = f'"v{version}"'


def _content_type(request: Request) -> str:
    return request.headers.get("content-type", "").partition(";")[0].strip().lower()


async def require_json(request: Request) -> None:
    """Refuse a body that is not JSON."""
    if not _is_json(request):
        raise UnsupportedContentError("Content-Type: send the body as application/json")


def _is_json(request: Request) -> bool:
    media_type = _content_type(request)
    return media_type == "application/json" or (
        media_type.startswith("application/") and media_type.endswith("+json")
    )


async def require_unique_keys(request: Request) -> None:
    """Refuse a JSON body that has a key twice in an object."""
    if not _is_json(request):
        return
    try:
        json.loads(await request.body(), object_pairs_hook=unique_keys)
    except (json.JSONDecodeError, UnicodeDecodeError, RecursionError):
        pass  # it is refused where it is read
    except ValueError as error:
        raise InvalidInputError(f"body: {error}") from None


async def require_multipart(request: Request) -> None:
    """Refuse a body that is not a form with files, has a field twice other than ``files``, or one
    that its path does not know.
    """
    if _content_type(request) != "multipart/form-data":
        raise UnsupportedContentError(
            "Content-Type: send the file and its fields as multipart/form-data"
        )
    names = [name for name, _ in (await request.form()).multi_items()]
    route = request.scope["route"]
    known = [parameter.alias for parameter in route.dependant.body_params]
    for name in names:
        if route.include_in_schema and name not in known:
            listed = ", ".join(known)
            raise InvalidInputError(f"{name[:60]}: is not a part of this form; known are {listed}")
        if name != "files" and names.count(name) > 1:
            raise InvalidInputError(f"{name[:60]}: is there twice; send it once")


async def accept_archive(_: Annotated[None, Depends(require_multipart)]) -> None:
    """Accept a form with a ZIP file, which may be larger than a photograph."""


def takes_archive(route: Any) -> bool:
    """Whether a route accepts a form with a ZIP file."""
    return accept_archive in dependencies_of(route)


def takes_upload(route: Any) -> bool:
    """Whether a route accepts a form with files."""
    return require_multipart in dependencies_of(route)
