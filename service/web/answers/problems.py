"""Every error as a problem document (RFC 9457), by one table from exception to HTTP status."""

import errno
import json
import logging
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

from model.errors import ImageRefusedError, InvalidInputError, ModelError, UnreachableError
from service.base import faults
from service.base.wording import field_of, sentence_of
from service.store.database import is_deadlock
from service.web.answers import pages

logger = logging.getLogger("heliotwin.service")

PROBLEM_MEDIA_TYPE = "application/problem+json"

# Pages load what this service serves and nothing else, and no page of others can frame them; pictures may also stand
# in the page itself, as those of Swagger UI do.
SECURITY_HEADERS = {
    "Content-Security-Policy": (
        "default-src 'self'; img-src 'self' data:; object-src 'none'; base-uri 'none'; form-action 'self'; "
        "frame-ancestors 'none'"
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
    ModelError: HTTPStatus.UNPROCESSABLE_ENTITY,
    faults.NotFoundError: HTTPStatus.NOT_FOUND,
    faults.ConflictError: HTTPStatus.CONFLICT,
    faults.GoneError: HTTPStatus.GONE,
    faults.StoreFullError: HTTPStatus.INSUFFICIENT_STORAGE,
    faults.NotAcceptableError: HTTPStatus.NOT_ACCEPTABLE,
    faults.TooLargeError: HTTPStatus.REQUEST_ENTITY_TOO_LARGE,
    faults.TooManyError: HTTPStatus.TOO_MANY_REQUESTS,
    faults.BusyError: HTTPStatus.SERVICE_UNAVAILABLE,
    faults.UnsupportedImageError: HTTPStatus.UNSUPPORTED_MEDIA_TYPE,
    faults.UnsupportedContentError: HTTPStatus.UNSUPPORTED_MEDIA_TYPE,
    faults.StoreDamagedError: HTTPStatus.INTERNAL_SERVER_ERROR,
}

# Where the same request may succeed later, after so many seconds.
_RETRY_AFTER_S: dict[type[Exception], str] = {
    faults.TooManyError: "30",
    faults.BusyError: "5",
    faults.StoreFullError: "3600",
}

# PostgreSQL's code for a disk without room.
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
    415: "not-taken",
    422: "invalid",
    429: "too-many",
    500: "failure",
    503: "busy",
    507: "no-room",
}
"""What is wrong by status, as `type` names it: ``urn:heliotwin:problem:`` and this. These names never change."""


def request_id(scope: Scope) -> str:
    """The request's id, as `service.web.middleware` gave it."""
    return str(scope.get("state", {}).get("request_id", ""))


def problem(
    scope: Scope, status: int, detail: str, headers: Mapping[str, str] | None = None, **extension: Any
) -> Response:
    """A problem document as a response, ASCII, so that any text in it can be sent; as a page where a person asks."""
    document = {
        "type": f"urn:heliotwin:problem:{TYPES.get(status, TYPES[400 if status < 500 else 500])}",
        "title": HTTPStatus(status).phrase,
        "status": status,
        "detail": detail,
        "instance": scope.get("path", ""),
        "request_id": request_id(scope),
        **extension,
    }
    if pages.wants_page(scope):
        answer = pages.error_page(scope, document)
        answer.headers.update(headers or {})
        return answer
    return Response(
        json.dumps(document), status_code=status, headers=dict(headers or {}), media_type=PROBLEM_MEDIA_TYPE
    )


def _on_known(request: Request, error: Exception) -> Response:
    status = next(STATUS[kind] for kind in type(error).__mro__ if kind in STATUS)
    if isinstance(error, faults.StoreDamagedError):
        logger.error("%s, request %s", error, request_id(request.scope))
    if isinstance(error, faults.NotAcceptableError):
        return problem(request.scope, status, str(error), offered=list(error.offered))
    wait_s = _RETRY_AFTER_S.get(type(error))
    return problem(request.scope, status, str(error), {} if wait_s is None else {"Retry-After": wait_s})


def _field_problem(entry: Mapping[str, Any]) -> dict[str, str]:
    """Which field is wrong, without the part of the request that it stands in, and what to do about it."""
    location = entry["loc"]
    inner = location[1:] if location and location[0] in ("body", "path", "query", "header") else location
    if entry["type"] == "json_invalid" and isinstance(location[-1], int):
        inner = ()  # the place of the fault stands where a field's name would
    return {"field": field_of(inner) or "body", "message": sentence_of(entry)}


def _on_validation(request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)
    errors = [_field_problem(entry) for entry in error.errors()]
    detail = "; ".join(f"{entry['field']}: {entry['message']}" for entry in errors[:5])
    return problem(request.scope, HTTPStatus.UNPROCESSABLE_ENTITY, detail, errors=errors[:100])


def _on_http(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    phrase = HTTPStatus(error.status_code).phrase
    # What a body could not be read for is told by its reader, in words that are not ours.
    plain = str(error.detail) in ("", phrase) or error.status_code == HTTPStatus.BAD_REQUEST
    detail = _REMEDIES.get(error.status_code, phrase) if plain else str(error.detail)
    return problem(request.scope, error.status_code, detail, error.headers)


def _is_full(error: BaseException) -> bool:
    """Whether a disk, or the database's, has no room left."""
    if isinstance(error, OSError):
        return error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
    if isinstance(error, OperationalError):
        origin: Any = error.orig
        codes = (getattr(origin, "sqlite_errorcode", None), getattr(origin, "sqlstate", None))
        return codes[0] == sqlite3.SQLITE_FULL or codes[1] == _DISK_FULL
    return False


def _no_room(scope: Scope, error: Exception) -> Response:
    logger.error("no room left, request %s: %s", request_id(scope), error)
    detail = "the store's disk is full and nothing was kept; try again when its operator has made room"
    return problem(scope, HTTPStatus.INSUFFICIENT_STORAGE, detail, {"Retry-After": "60"})


def database_away(scope: Scope, error: Exception) -> Response:
    """The answer while the database does not give one, or can store no more."""
    if _is_full(error):
        return _no_room(scope, error)
    if is_deadlock(error):
        logger.warning("writers waited for each other, request %s: %s", request_id(scope), error)
        detail = "another request was changing the same things and nothing of this one was kept; send it again"
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
        return _no_room(request.scope, error)
    raise error


def _on_unexpected(request: Request, error: Exception) -> Response:
    identity = request_id(request.scope)
    logger.error("unexpected error, request %s", identity, exc_info=error, extra={"request_id": identity})
    detail = "the service failed; report the request_id to its operator"
    # This handler stands outside the middleware that adds these.
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
