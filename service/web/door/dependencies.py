"""What routes ask for in their signatures.

None of it holds a database connection: a route opens its session itself and closes it before it returns. A session
from a dependency would keep its connection while the request waits for a thread, and threads would wait for it.
"""

import threading
from collections.abc import AsyncIterator
from contextlib import AbstractAsyncContextManager
from typing import Annotated

from fastapi import Depends, Path, Query, Request

from service.base.faults import UnsupportedContentError
from service.base.fields import MeasurementName, Name
from service.jobs.kind import Kinds
from service.twin.field import FieldBook
from service.twin.runtime import Runtime
from service.web.door.security import Identity, Requires, Role, presented_key
from service.web.door.turns import Turns


async def get_runtime(request: Request) -> Runtime:
    """The parts of the running service."""
    runtime: Runtime = request.app.state.runtime
    return runtime


RuntimeDep = Annotated[Runtime, Depends(get_runtime)]


async def _field(request: Request) -> FieldBook:
    book: FieldBook = request.app.state.field
    return book


FieldBookDep = Annotated[FieldBook, Depends(_field)]
"""What is worked out once of each heliostat of the field."""

# For a route's ``dependencies``: whoever has at least this role is let in.
READ = Depends(Requires(Role.READ))
INGEST = Depends(Requires(Role.INGEST))
OPERATE = Depends(Requires(Role.OPERATE))
ADMIN = Depends(Requires(Role.ADMIN))


async def _identity(request: Request) -> Identity:
    identity: Identity = request.state.identity
    return identity


IdentityDep = Annotated[Identity, Depends(_identity)]
"""Who asks; for routes that `requires` a role."""


async def _presented(request: Request) -> str | None:
    return presented_key(request.headers)


PresentedDep = Annotated[str | None, Depends(_presented)]
"""The key that was presented; for answers that go on for as long as it opens."""


async def _stopping(request: Request) -> threading.Event:
    event: threading.Event = request.app.state.stopping
    return event


StoppingDep = Annotated[threading.Event, Depends(_stopping)]
"""Set when the service is told to stop, so that answers without an end end."""


async def _kinds(request: Request) -> Kinds:
    kinds: Kinds = request.app.state.kinds
    return kinds


KindsDep = Annotated[Kinds, Depends(_kinds)]
"""The kinds of jobs that this service takes."""


def turn(request: Request) -> AbstractAsyncContextManager[None]:
    """A turn at what is heavy to write or to draw, for the key that asks."""
    turns: Turns = request.app.state.turns
    identity: Identity = request.state.identity
    return turns.one(identity.name)


async def _turn(request: Request) -> AsyncIterator[None]:
    async with turn(request):
        yield


async def _computing(request: Request) -> AsyncIterator[None]:
    turns: Turns = request.app.state.computing
    identity: Identity = request.state.identity
    async with turns.one(identity.name):
        yield


# For a route's ``dependencies``. A turn ends before the answer is sent, so that a slow reader keeps nobody waiting.
DRAWS = Depends(_turn, scope="function")
"""A turn at drawing maps."""
Turn = Annotated[None, DRAWS]
"""The same in a signature, for what comes after other dependencies."""
COMPUTES = Depends(_computing, scope="function")
"""A turn at waiting for the model, so that one key does not fill the line before it."""


NamePath = Annotated[Name, Path(description="Name of the heliostat or target.")]
MeasurementPath = Annotated[MeasurementName, Path()]
Limit = Annotated[int, Query(ge=1, le=500, description="Most items on a page.")]


def _content_type(request: Request) -> str:
    return request.headers.get("content-type", "").partition(";")[0].strip().lower()


async def require_json(request: Request) -> None:
    """Refuse a body that is not JSON."""
    given = _content_type(request)
    if given != "application/json" and not (given.startswith("application/") and given.endswith("+json")):
        raise UnsupportedContentError("Content-Type: send the body as application/json")


async def require_multipart(request: Request) -> None:
    """Refuse a body that is not a form with files."""
    if _content_type(request) != "multipart/form-data":
        raise UnsupportedContentError("Content-Type: send the image and its metadata as multipart/form-data")
