"""The OpenAPI document: what errors look like, and which routes may answer with which."""

from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi

from service.web.answers import formats
from service.web.answers.problem_schema import Problem
from service.web.answers.problems import PROBLEM_MEDIA_TYPE
from service.web.door import security

_MEANINGS = {
    400: "The body could not be read.",
    401: "A key is needed, and none that is valid was presented.",
    403: "The key's role is not enough, or the request comes from another site's page.",
    404: "Something that the path or the body names is not stored.",
    405: "This path takes other methods only; see Allow.",
    406: "None of the media types in Accept is offered.",
    408: "The body did not come in time.",
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


_TAGS = [
    {"name": "plant", "description": "The tower base, which everything is measured from, its targets and receivers."},
    {"name": "heliostats", "description": "Where heliostats stand and how they are built (PAINT properties)."},
    {"name": "measurements", "description": "Target photographs: post them, read flux and quality back."},
    {"name": "surfaces", "description": "Mirror surfaces by version: predict them, read the history."},
    {"name": "forecasts", "description": "Flux maps of one heliostat on any plane, or of a field on any receiver."},
    {
        "name": "studies",
        "description": "What photographs demand and the model lacks: find it, adopt it into the model, withdraw it. "
        "Differences, as `residual.mean_map_8x8` [of the measured peak], are forecast minus photograph.",
    },
    {"name": "jobs", "description": "Work that outlives a request: ask for it, follow it, cancel it."},
    {"name": "audit", "description": "Who did what when."},
    {"name": "session", "description": "For pages: a key in a cookie."},
    {"name": "health", "description": "For supervisors."},
]

TEXT = {"type": "string"}
BINARY = {"type": "string", "format": "binary"}


def problems(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """Documented error answers of a route; those that do not depend on what it does come by themselves."""
    return {status: {"model": Problem, "description": _MEANINGS[status]} for status in sorted({500, *statuses})}


def arrays(model: Any, description: str) -> dict[int | str, dict[str, Any]]:
    """A documented answer in several representations beside JSON, which is a ``model``'s."""
    binary = {media_type: {"schema": BINARY} for media_type in formats.ARRAYS[1:]}
    return {200: {"model": model, "description": description, "content": binary}}


def _as_problem(response: dict[str, Any]) -> None:
    content = response.get("content", {})
    if "application/json" in content:
        content[PROBLEM_MEDIA_TYPE] = content.pop("application/json")


def _as_form(body: dict[str, Any]) -> None:
    """A photograph's form as generators of clients and Swagger's page take it: a file, and a JSON document."""
    image, metadata = body["properties"]["image"], body["properties"]["metadata"]
    image.pop("contentMediaType", None)
    image["format"] = "binary"
    schema = metadata.pop("contentSchema")
    body["properties"]["metadata"] = schema


def _by_themselves(path: str, method: str, operation: dict[str, Any]) -> set[int]:
    """Statuses that come of the door and of the request's form, whatever the route does."""
    statuses, needs_key = {405, 500}, "security" in operation
    if path not in security.HEALTH:
        statuses |= {429, 503}
    if needs_key:
        statuses |= {401, 403}
    if method != "get":
        statuses |= {403, 413, 507} if needs_key else {403, 413}
    if "parameters" in operation:
        statuses |= {422}
    if "requestBody" in operation:
        statuses |= {400, 408, 413, 415, 422}
    return statuses


def _document(app: FastAPI) -> dict[str, Any]:
    document = get_openapi(
        title=app.title, version=app.version, description=app.description, routes=app.routes, tags=_TAGS
    )
    problem = {"application/json": {"schema": {"$ref": "#/components/schemas/Problem"}}}
    for path, operations in document["paths"].items():
        for method, operation in operations.items():
            responses = operation["responses"]
            if "HTTPValidationError" in str(responses.get("422")):
                del responses["422"]  # FastAPI's own form of it
            for status in _by_themselves(path, method, operation):
                responses.setdefault(str(status), {"description": _MEANINGS[status], "content": dict(problem)})
            operation["responses"] = dict(sorted(responses.items()))
            for status, response in responses.items():
                if int(status) >= 400 and "Problem" in str(response):
                    _as_problem(response)
    _as_form(document["components"]["schemas"]["Body_post_measurement"])
    post = document["paths"]["/v1/heliostats/{name}/measurements"]["post"]
    post["requestBody"]["content"]["multipart/form-data"]["encoding"] = {
        "metadata": {"contentType": "application/json"}
    }
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
