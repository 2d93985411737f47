"""What routes ask for in their signatures.

None of it holds a database connection: a route opens its session itself and closes it before it returns. A session
from a dependency would keep its connection while the request waits for a thread, and threads would wait for it.
"""

from typing import Annotated

from fastapi import Depends, Header, Path, Query, Request

from service import negotiation
from service.faults import UnsupportedContentError
from service.runtime import Runtime
from service.schemas import MeasurementName, Name


async def get_runtime(request: Request) -> Runtime:
    """The parts of the running service."""
    runtime: Runtime = request.app.state.runtime
    return runtime


RuntimeDep = Annotated[Runtime, Depends(get_runtime)]


NamePath = Annotated[Name, Path(description="Name of the heliostat or target.")]
MeasurementPath = Annotated[MeasurementName, Path()]
Limit = Annotated[int, Query(ge=1, le=500, description="Most items on a page.")]


async def _media_type(
    accept: Annotated[
        str | None, Header(description=f"One of {', '.join(negotiation.ARRAYS)}; JSON by default.")
    ] = None,
) -> str:
    return negotiation.choose(accept)


MediaType = Annotated[str, Depends(_media_type)]


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
