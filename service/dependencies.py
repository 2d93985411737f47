"""What routes ask for in their signatures."""

from collections.abc import Iterator
from typing import Annotated

from fastapi import Depends, Header, Path, Query, Request
from sqlalchemy.orm import Session

from service import negotiation, store
from service.faults import UnsupportedContentError
from service.runtime import Runtime
from service.schemas import MeasurementName, Name
from service.tables import HeliostatRow


def get_runtime(request: Request) -> Runtime:
    """The parts of the running service."""
    runtime: Runtime = request.app.state.runtime
    return runtime


RuntimeDep = Annotated[Runtime, Depends(get_runtime)]


def _reading(runtime: RuntimeDep) -> Iterator[Session]:
    with runtime.database.reading() as session:
        yield session


ReadSession = Annotated[Session, Depends(_reading)]
NamePath = Annotated[Name, Path(description="Name of the heliostat or target.")]
MeasurementPath = Annotated[MeasurementName, Path()]
Limit = Annotated[int, Query(ge=1, le=500, description="Most items on a page.")]


def _heliostat(name: NamePath, session: ReadSession) -> HeliostatRow:
    return store.get_heliostat(session, name)


HeliostatDep = Annotated[HeliostatRow, Depends(_heliostat)]


def _media_type(
    accept: Annotated[
        str | None, Header(description=f"One of {', '.join(negotiation.ARRAYS)}; JSON by default.")
    ] = None,
) -> str:
    return negotiation.choose(accept)


MediaType = Annotated[str, Depends(_media_type)]


def _content_type(request: Request) -> str:
    return request.headers.get("content-type", "").partition(";")[0].strip().lower()


def require_json(request: Request) -> None:
    """Refuse a body that is not JSON."""
    given = _content_type(request)
    if given != "application/json" and not (given.startswith("application/") and given.endswith("+json")):
        raise UnsupportedContentError("Content-Type: send the body as application/json")


def require_multipart(request: Request) -> None:
    """Refuse a body that is not a form with files."""
    if _content_type(request) != "multipart/form-data":
        raise UnsupportedContentError("Content-Type: send the image and its metadata as multipart/form-data")
