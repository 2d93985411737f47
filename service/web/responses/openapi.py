"""The OpenAPI document: the schema of errors (RFC 9457), and the error statuses of each route."""

import json
import re
from pathlib import Path
from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi
from pydantic import BaseModel, Field

from service.web.auth import security
from service.web.responses import formats
from service.web.responses.problems import PROBLEM_MEDIA_TYPE


class FieldProblem(BaseModel):
    """The error in one field of the request."""

    field: str = Field(description="Path of the field.", examples=["sun.elevation_deg"])
    message: str = Field(description="What is wrong.", examples=["must be 90 or less"])


class Problem(BaseModel):
    """An error (RFC 9457)."""

    type: str = Field(
        description="Stable name of what is wrong; the guide lists all of them.",
        examples=["urn:heliotwin:problem:invalid"],
    )
    title: str = Field(description="Name of the status.", examples=["Unprocessable Content"])
    status: int = Field(description="The HTTP status.", examples=[422])
    detail: str = Field(
        description="What is wrong, and what to do.",
        examples=["sun.elevation_deg: must be 90 or less"],
    )
    instance: str = Field(description="Path of the request.", examples=["/v1/forecasts"])
    request_id: str = Field(
        description="Quote it when reporting a fault; it is in the service's log."
    )
    errors: list[FieldProblem] | None = Field(
        default=None, description="Every field at fault, of a request that is invalid (422)."
    )
    offered: list[str] | None = Field(
        default=None, description="Acceptable media types, where none was acceptable."
    )


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
    421: "Host is no name of this service, and no key was presented.",
    422: "A field is wrong; the detail names it.",
    429: "Too many requests, or too many jobs that wait; see Retry-After.",
    500: "The service failed.",
    507: "The store has no space left, and nothing was stored.",
    503: (
        "The database does not answer, the weights are damaged, or the service is busy; see"
        " Retry-After."
    ),
}


_TAGS = {
    "plant": "The tower base, which everything is measured from, its targets and receivers.",
    "heliostats": "Where heliostats are and how they are built (PAINT properties).",
    "measurements": "Target photographs: post them, read flux and quality back.",
    "surfaces": "Mirror surfaces by version: predict them, read the history.",
    "forecasts": "Flux maps of one heliostat on any plane, or of a field on any receiver.",
    "mounts": "Where motors send the light: mounts, pointing errors, what to photograph next.",
    "studies": (
        "What photographs demand and the model lacks: find it, adopt it into the model, withdraw"
        " it. Differences, as `residual.mean_map_8x8` [of the measured peak], are forecast minus"
        " photograph."
    ),
    "jobs": "Work that outlives a request: ask for it, follow it, cancel it.",
    "alarms": "Alarms, and who has acknowledged them.",
    "audit": "Who did what when.",
    "session": "For pages: a session in a cookie.",
    "health": "For supervisors.",
}
"""Groups of operations, in the order of the work."""

_EXAMPLES = Path(__file__).parents[1] / "examples.json"
"""Bodies and answers of a real run; ``python -m tests.openapi_examples`` records them."""

TEXT = {"type": "string"}
BINARY = {"type": "string", "format": "binary"}


def problems(*statuses: int) -> dict[int | str, dict[str, object]]:
    """Documented error responses of a route.

    Statuses that do not depend on the work of the route are added automatically.
    """
    return {
        status: {"model": Problem, "description": _MEANINGS[status]}
        for status in sorted({500, *statuses})
    }


def arrays(model: Any, description: str) -> dict[int | str, dict[str, object]]:
    """Documented response with a JSON ``model`` and its other representations."""
    binary = {media_type: {"schema": BINARY} for media_type in formats.ARRAYS[1:]}
    return {200: {"model": model, "description": description, "content": binary}}


def _as_form(body: dict[str, Any]) -> None:
    """Describe the form of a photograph as client generators and Swagger UI expect it.

    The form has a file and a JSON document. FastAPI documents the missing file as null, but a form
    cannot hold null. A form without a file has no such part.
    """
    image, metadata = body["properties"]["image"], body["properties"]["metadata"]
    image.pop("anyOf", None)
    image |= {"type": "string", "format": "binary"}
    schema = metadata.pop("contentSchema")
    body["properties"]["metadata"] = schema | {"description": "JSON that describes the image."}


def _by_themselves(path: str, method: str, operation: dict[str, Any]) -> set[int]:
    """Statuses of authentication and of invalid requests, which do not depend on the route."""
    statuses, needs_key = {405, 500}, "security" in operation
    if path not in security.HEALTH:
        statuses |= {429, 503}
    if needs_key:
        statuses |= {401, 403, 421}
    if method != "get":
        statuses |= {403, 413, 507} if needs_key else {403, 413}
    if "parameters" in operation:
        statuses |= {422}
    if "requestBody" in operation:
        statuses |= {400, 408, 413, 415, 422}
    return statuses


def _add_examples(operation: dict[str, Any], recorded: Any) -> None:
    """Add the recorded body and answers of an operation."""
    if "body" in recorded:
        (content,) = operation["requestBody"]["content"].values()
        content["example"] = recorded["body"]
    for status, answers in recorded["answers"].items():
        for media_type, answer in answers.items():
            operation["responses"][status]["content"][media_type]["example"] = answer


def _document(app: FastAPI) -> dict[str, Any]:
    document = get_openapi(
        title=app.title,
        version=app.version,
        description=app.description,
        routes=app.routes,
        tags=[{"name": name, "description": about} for name, about in _TAGS.items()],
    )
    examples = json.loads(_EXAMPLES.read_text(encoding="utf-8"))
    problem = {"application/json": {"schema": {"$ref": "#/components/schemas/Problem"}}}
    for path, operations in document["paths"].items():
        for method, operation in operations.items():
            responses = operation["responses"]
            about = operation.get("description", operation["summary"])
            operation["summary"] = re.split(r"\.(?:\s|$)", about, maxsplit=1)[0]
            _add_examples(operation, examples.get(operation["operationId"], {"answers": {}}))
            if "HTTPValidationError" in str(responses.get("422")):
                del responses["422"]  # the default schema of FastAPI
            for status in _by_themselves(path, method, operation):
                responses.setdefault(
                    str(status), {"description": _MEANINGS[status], "content": dict(problem)}
                )
            operation["responses"] = dict(sorted(responses.items()))
            for status, response in responses.items():
                content = response.get("content", {})
                if int(status) >= 400 and "Problem" in str(content.get("application/json")):
                    content[PROBLEM_MEDIA_TYPE] = content.pop("application/json")
    schemas = document["components"]["schemas"]
    _as_form(schemas["Body_post_measurement"])
    # The form of the documentation page begins with this example.
    schemas["MeasurementIn"]["examples"] = [examples["post_measurement"]["body"]["metadata"]]
    post = document["paths"]["/v1/heliostats/{name}/measurements"]["post"]
    post["requestBody"]["content"]["multipart/form-data"]["encoding"] = {
        "metadata": {"contentType": "application/json"}
    }
    for unused in ("HTTPValidationError", "ValidationError"):
        schemas.pop(unused, None)
    return document


def install(app: FastAPI) -> None:
    """Make ``app`` serve this document instead of the default of FastAPI."""

    def openapi() -> dict[str, object]:
        if app.openapi_schema is None:
            app.openapi_schema = _document(app)
        return app.openapi_schema

    app.openapi = openapi  # type: ignore[method-assign]  # as the FastAPI documentation does
