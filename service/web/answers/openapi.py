"""The OpenAPI document: what errors look like, and which routes may answer with which."""

from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi

from service.web.answers import formats
from service.web.answers.problem_schema import Problem
from service.web.answers.problems import PROBLEM_MEDIA_TYPE

_MEANINGS = {
    400: "The body could not be read.",
    401: "A key is needed, and none that is valid was presented.",
    403: "The key's role is not enough, or the request comes from another site's page.",
    404: "Something that the path or the body names is not stored.",
    406: "None of the media types in Accept is offered.",
    409: "The store is in no state to do this; the detail says what to do first.",
    410: "It was kept, and no longer is; the detail says why.",
    413: "The body or the image is too large.",
    415: "The body or the image is of a format that is not taken.",
    422: "A field is wrong; the detail names it.",
    429: "Too many requests, or too many jobs that wait; see Retry-After.",
    500: "The service failed.",
    507: "The store has no room left, and nothing was kept.",
    503: "The database does not answer, or the service is busy; see Retry-After.",
}

_ANYWHERE = (401, 403, 422, 429, 500, 503)

_TAGS = [
    {"name": "plant", "description": "The tower base, which everything is measured from, its targets and receivers."},
    {"name": "heliostats", "description": "Where heliostats stand and how they are built (PAINT properties)."},
    {"name": "measurements", "description": "Target photographs: post them, read flux and quality back."},
    {"name": "surfaces", "description": "Mirror surfaces by version: predict them, read the history."},
    {"name": "forecasts", "description": "Flux maps of one heliostat on any plane, or of a field on any receiver."},
    {
        "name": "studies",
        "description": "What photographs demand and the model lacks: find it, adopt it into the model, withdraw it.",
    },
    {"name": "jobs", "description": "Work that outlives a request: ask for it, follow it, cancel it."},
    {"name": "audit", "description": "Who did what when."},
    {"name": "session", "description": "For pages: a key in a cookie."},
    {"name": "health", "description": "For supervisors."},
]

_BINARY = {"type": "string", "format": "binary"}


def problems(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """Documented error answers of a route; every route may also fail for other reasons of its own or the door's."""
    return {status: {"model": Problem, "description": _MEANINGS[status]} for status in sorted({*statuses, *_ANYWHERE})}


def arrays(description: str) -> dict[int | str, dict[str, Any]]:
    """A documented answer in several representations beside JSON."""
    binary = {media_type: {"schema": _BINARY} for media_type in formats.ARRAYS[1:]}
    return {200: {"description": description, "content": binary}}


def _as_problem(response: dict[str, Any]) -> None:
    content = response.get("content", {})
    if "application/json" in content:
        content[PROBLEM_MEDIA_TYPE] = content.pop("application/json")


def _document(app: FastAPI) -> dict[str, Any]:
    document = get_openapi(
        title=app.title, version=app.version, description=app.description, routes=app.routes, tags=_TAGS
    )
    for path in document["paths"].values():
        for operation in path.values():
            for status, response in operation["responses"].items():
                if status.isdecimal() and int(status) >= 400 and "Problem" in str(response):
                    _as_problem(response)
    for unused in ("HTTPValidationError", "ValidationError"):
        document["components"]["schemas"].pop(unused, None)
    return document


def install(app: FastAPI) -> None:
    """Give ``app`` this document instead of FastAPI's own."""

    def openapi() -> dict[str, Any]:
        if app.openapi_schema is None:
            app.openapi_schema = _document(app)
        return app.openapi_schema

    app.openapi = openapi  # type: ignore[method-assign]  # the way FastAPI documents
