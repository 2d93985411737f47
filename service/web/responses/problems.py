"""Problem documents (RFC 9457), with one table from exception to HTTP status."""

import errno
import json
import logging
import re
import sqlite3
from collections.abc import Mapping
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from sqlalchemy.exc import OperationalError
from sqlalchemy.exc import TimeoutError as PoolTimeoutError
from starlette.exceptions import HTTPException
from starlette.types import Scope

from model.errors import (
    ImageRefusedError,
    InvalidInputError,
    ModelError,
    UnreachableError,
    WeightsError,
)
from service.base import errors
from service.base.validation import field_of, message_of
from service.store.database import is_deadlock
from service.web.responses import pages

logger = logging.getLogger("heliotwin.service")

PROBLEM_MEDIA_TYPE = "application/problem+json"

# Pages load only what this service serves, and no other site can frame them. Data URLs are allowed
# for images, because Swagger UI uses them.
SECURITY_HEADERS = {
    "Content-Security-Policy": (
        "default-src 'self'; img-src 'self' data:; object-src 'none'; base-uri 'none'; form-action"
        " 'self'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}

STATUS: dict[type[Exception], HTTPStatus] = {
    InvalidInputError: HTTPStatus.UNPROCESSABLE_ENTITY,
    UnreachableError: HTTPStatus.UNPROCESSABLE_ENTITY,
    ImageRefusedError: HTTPStatus.UNPROCESSABLE_ENTITY,
    WeightsError: HTTPStatus.SERVICE_UNAVAILABLE,
    ModelError: HTTPStatus.UNPROCESSABLE_ENTITY,
    errors.NotFoundError: HTTPStatus.NOT_FOUND,
    errors.ConflictError: HTTPStatus.CONFLICT,
    errors.GoneError: HTTPStatus.GONE,
    errors.StoreFullError: HTTPStatus.INSUFFICIENT_STORAGE,
    errors.NotAcceptableError: HTTPStatus.NOT_ACCEPTABLE,
    errors.TooLargeError: HTTPStatus.REQUEST_ENTITY_TOO_LARGE,
    errors.TooManyError: HTTPStatus.TOO_MANY_REQUESTS,
    errors.BusyError: HTTPStatus.SERVICE_UNAVAILABLE,
    errors.UnsupportedImageError: HTTPStatus.UNSUPPORTED_MEDIA_TYPE,
    errors.UnsupportedContentError: HTTPStatus.UNSUPPORTED_MEDIA_TYPE,
    errors.StoreDamagedError: HTTPStatus.INTERNAL_SERVER_ERROR,
}

# Seconds after which the same request may succeed.
_RETRY_AFTER_S: dict[type[Exception], str] = {
    errors.TooManyError: "30",
    errors.BusyError: "5",
    errors.StoreFullError: "3600",
    WeightsError: "3600",
}

# PostgreSQL error code for a full disk.
_DISK_FULL = "53100"

_REMEDIES = {
    400: "the body could not be read; send it whole, in the form that Content-Type says",
    404: "there is nothing at this path; see /docs for the paths",
    405: "this path does not take this method; see the Allow header",
}


TYPES: dict[int, str] = {
    400: "unreadable",
    401: "key-needed",
    403: "not-allowed",
    404: "not-found",
    405: "other-method",
    406: "not-acceptable",
    408: "too-slow",
    409: "conflict",
    410: "gone",
    413: "too-large",
    415: "unsupported-media-type",
    421: "other-host",
    422: "invalid",
    429: "too-many",
    500: "failure",
    503: "busy",
    507: "insufficient-storage",
}
"""Problem types by status: ``urn:heliotwin:problem:`` and this name.

The names never change.
"""

SPECIAL_TYPES: dict[type, str] = {errors.IdempotencyReuseError: "idempotency-key-reused"}
"""Problem types of errors that have another one than their status."""


def request_id(scope: Scope) -> str:
    """The id of the request, from `service.web.middleware`."""
    return str(scope.get("state", {}).get("request_id", ""))


def problem(
    scope: Scope,
    status: int,
    detail: str,
    headers: Mapping[str, str] | None = None,
    name: str | None = None,
    **extension: Any,
) -> Response:
    """Response with a problem document, or with an error page for a browser.

    ``name`` is that of its type, by default the one of its status in `TYPES`.
    The JSON is ASCII, so that any text in it can be sent.
    """
    name = name or TYPES.get(status, TYPES[400 if status < 500 else 500])
    document = {
        "type": f"urn:heliotwin:problem:{name}",
        "title": HTTPStatus(status).phrase,
        "status": status,
        "detail": detail,
        "instance": scope.get("path", ""),
        "request_id": request_id(scope),
        **extension,
    }
    if pages.wants_page(scope):
        answer = pages.error_page(scope, status, document)
        answer.headers.update(headers or {})
        return answer
    return Response(
        json.dumps(document),
        status_code=status,
        headers=dict(headers or {}),
        media_type=PROBLEM_MEDIA_TYPE,
    )


def _on_known(request: Request, error: Exception) -> Response:
    status = next(STATUS[kind] for kind in type(error).__mro__ if kind in STATUS)
    if isinstance(error, errors.StoreDamagedError | WeightsError):
        logger.error("%s, request %s", error, request_id(request.scope))
    if isinstance(error, errors.NotAcceptableError):
        return problem(request.scope, status, str(error), offered=list(error.offered))
    if isinstance(error, errors.InvalidEntriesError):
        field_errors = [
            {"field": f"{error.where}.{place}", "message": why}
            for place, why in list(error.wrong.items())[:100]
        ]
        return problem(request.scope, status, str(error), errors=field_errors)
    if status is HTTPStatus.UNPROCESSABLE_ENTITY:
        name = SPECIAL_TYPES.get(type(error))
        return problem(request.scope, status, str(error), name=name, errors=[_named_problem(error)])
    wait_s = _RETRY_AFTER_S.get(type(error))
    return problem(
        request.scope, status, str(error), {} if wait_s is None else {"Retry-After": wait_s}
    )


# Forms in which messages name a field: `field: what to do`, `where: 'field' what to do` or `where:
# field must ..`.
_NAMED = re.compile(
    r"([A-Za-z_][\w.-]*): (.+)|(?:[^:]+: )?(?:'([\w.]+)' .+|(\w+) must .+)", re.DOTALL
)


def _named_problem(error: Exception) -> dict[str, str]:
    """The field that one of our errors names, and its message.

    The field is `image` or `body` if the error names none.
    """
    if isinstance(error, ImageRefusedError):
        return {"field": "image", "message": str(error)}
    found = _NAMED.fullmatch(str(error))
    if found is None:
        return {"field": "body", "message": str(error)}
    return {"field": found[1] or found[3] or found[4], "message": found[2] or str(error)}


def _field_problem(entry: Mapping[str, Any]) -> dict[str, str]:
    """The wrong field and what to do about it.

    The field is without the part of the request that holds it, such as `body`, or the part
    `metadata` of a form.
    """
    location = entry["loc"]
    inner = (
        location[1:]
        if location and location[0] in ("body", "path", "query", "header")
        else location
    )
    if inner[:1] == ("metadata",) and inner[1:]:
        inner = inner[1:]
    if entry["type"] == "json_invalid" and isinstance(location[-1], int):
        inner = ()  # here the location is a position in the text, not a field
    return {"field": field_of(inner) or "body", "message": message_of(entry)}


def _on_validation(request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)
    field_errors = [_field_problem(entry) for entry in error.errors()[:100]]
    detail = "; ".join(f"{entry['field']}: {entry['message']}" for entry in field_errors[:5])
    return problem(request.scope, HTTPStatus.UNPROCESSABLE_ENTITY, detail, errors=field_errors)


def _on_http(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    phrase, cause = HTTPStatus(error.status_code).phrase, error.__cause__
    if cause is not None and _is_full(cause):  # FastAPI reports 400 if it cannot buffer a body
        return _insufficient_storage(request.scope, cause)
    # The parser of the body writes its own messages, so they are replaced.
    plain = str(error.detail) in ("", phrase) or error.status_code == HTTPStatus.BAD_REQUEST
    detail = _REMEDIES.get(error.status_code, phrase) if plain else str(error.detail)
    return problem(request.scope, error.status_code, detail, error.headers)


def _is_full(error: BaseException) -> bool:
    """Whether the disk of the service, or of the database, is full."""
    if isinstance(error, OSError):
        return error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
    if isinstance(error, OperationalError):
        origin: Any = error.orig
        codes = (getattr(origin, "sqlite_errorcode", None), getattr(origin, "sqlstate", None))
        return codes[0] == sqlite3.SQLITE_FULL or codes[1] == _DISK_FULL
    return False


def _insufficient_storage(scope: Scope, error: BaseException) -> Response:
    logger.error("no space left, request %s: %s", request_id(scope), error)
    detail = (
        "a disk of the service is full and nothing was stored; try again when its operator has"
        " freed space"
    )
    return problem(scope, HTTPStatus.INSUFFICIENT_STORAGE, detail, {"Retry-After": "60"})


def database_away(scope: Scope, error: Exception) -> Response:
    """Response if the database is unavailable, busy or full."""
    if _is_full(error):
        return _insufficient_storage(scope, error)
    if is_deadlock(error):
        logger.warning("writers waited for each other, request %s: %s", request_id(scope), error)
        detail = (
            "another request was changing the same things and nothing of this one was kept; send it"
            " again"
        )
        return problem(scope, HTTPStatus.SERVICE_UNAVAILABLE, detail, {"Retry-After": "1"})
    if isinstance(error, PoolTimeoutError):
        logger.warning("no free database connection, request %s", request_id(scope))
        detail = "all connections to the database are busy; try again later"
        return problem(scope, HTTPStatus.SERVICE_UNAVAILABLE, detail, {"Retry-After": "5"})
    logger.error("database unavailable, request %s: %s", request_id(scope), error)
    detail = "the database does not answer; try again later"
    return problem(scope, HTTPStatus.SERVICE_UNAVAILABLE, detail, {"Retry-After": "5"})


def _on_database_away(request: Request, error: Exception) -> Response:
    return database_away(request.scope, error)


def _on_os(request: Request, error: Exception) -> Response:
    if _is_full(error):
        return _insufficient_storage(request.scope, error)
    raise error


def _on_unexpected(request: Request, error: Exception) -> Response:
    identity = request_id(request.scope)
    logger.error(
        "unexpected error, request %s", identity, exc_info=error, extra={"request_id": identity}
    )
    detail = "the service failed; report the request_id to its operator"
    # This handler runs outside the middleware that adds these headers.
    headers = {"X-Request-ID": request_id(request.scope), **SECURITY_HEADERS}
    return problem(request.scope, HTTPStatus.INTERNAL_SERVER_ERROR, detail, headers)


def install(app: FastAPI) -> None:
    """Make ``app`` answer every error with a problem document."""
    for kind in STATUS:
        app.add_exception_handler(kind, _on_known)
    app.add_exception_handler(RequestValidationError, _on_validation)
    app.add_exception_handler(HTTPException, _on_http)
    app.add_exception_handler(OperationalError, _on_database_away)
    app.add_exception_handler(PoolTimeoutError, _on_database_away)
    app.add_exception_handler(OSError, _on_os)
    app.add_exception_handler(Exception, _on_unexpected)
