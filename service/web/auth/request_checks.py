"""Checks of requests: known query parameters, the shape of JSON, and the bytes held per key.

A route accepts the query parameters that it documents, and no others.
"""

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from http import HTTPStatus

import numpy as np
from fastapi import HTTPException, Request
from fastapi.dependencies.models import Dependant
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel

from service.base.settings import Settings


def query_names(dependant: Dependant) -> list[str]:
    """Names of the query parameters that a route and its dependencies accept."""
    names = [name for inner in dependant.dependencies for name in query_names(inner)]
    for parameter in dependant.query_params:
        kind = parameter.field_info.annotation
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            names += [field.alias or name for name, field in kind.model_fields.items()]
        else:
            names.append(parameter.alias)
    return list(dict.fromkeys(names))


async def require_known_query(request: Request) -> None:
    """Refuse query parameters that the route does not know.

    Otherwise, a misspelled filter would return the unfiltered list.
    """
    known = query_names(request.scope["route"].dependant)
    unknown = [name for name in request.query_params if name not in known]
    if unknown:
        listed = f"known are {', '.join(known)}" if known else "this path takes none"
        message = ValueError(f"is not a parameter of this path; {listed}")
        raise RequestValidationError(
            [
                {
                    "type": "value_error",
                    "loc": ("query", name),
                    "msg": str(message),
                    "ctx": {"error": message},
                }
                for name in unknown
            ]
        )


MAX_KEYS = 50_000
"""Most keys in a JSON body: a plan with two aim points for each of 20,000 heliostats has 40,000."""

MAX_DEPTH = 64
"""Deepest nesting of a JSON body. PAINT documents have ten levels."""

# Number of levels that each byte opens (1) or closes (-1).
_LEVELS = np.zeros(256, dtype=np.int8)
_LEVELS[list(b"[{")], _LEVELS[list(b"]}")] = 1, -1


class JsonShape:
    """Counter of the keys and the depth of JSON while it arrives.

    It counts colons and brackets, including those inside strings.
    """

    def __init__(self) -> None:
        self.keys = 0
        self._depth = 0

    def add(self, part: bytes) -> None:
        """Count the next ``part``.

        Raises
        ------
        HTTPException
            413 if the body has too many keys or levels. The message names the limit.
        """
        self.keys += part.count(b":")
        if self.keys > MAX_KEYS:
            raise _too_large(
                f"body: more than the {MAX_KEYS} keys allowed; send fewer entries at a time"
            )
        if part:
            depths = self._depth + np.cumsum(
                _LEVELS[np.frombuffer(part, dtype=np.uint8)], dtype=np.int64
            )
            self._depth = int(depths[-1])
            if depths.max() > MAX_DEPTH:
                raise _too_large(
                    f"body: nested deeper than the {MAX_DEPTH} levels allowed; send it flatter"
                )


def _too_large(detail: str) -> HTTPException:
    return HTTPException(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, detail)


class BodyLimiter:
    """Limits on the request bodies that the service holds at the same time.

    A body counts from its first byte until its request is answered. Each key has a share of the
    bytes, so slow senders fill neither the memory nor the temporary folder. The limiter belongs to
    one event loop. Its methods never wait, so it needs no lock.
    """

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._bytes: Counter[str] = Counter()
        self._uploads: Counter[str] = Counter()

    @contextmanager
    def body(self, name: str) -> Iterator["HeldBody"]:
        """Count a body of the key ``name`` while the block runs."""
        body = HeldBody(self, name)
        try:
            yield body
        finally:
            self._bytes -= Counter({name: body.size})  # `-=` also removes entries that become 0
            self._uploads -= Counter({name: int(body.is_upload)})

    def held_uploads(self, name: str) -> int:
        """Number of photographs that the key ``name`` is sending."""
        return self._uploads[name]

    def held_bytes(self) -> int:
        """Size of all bodies that are held [bytes]."""
        return self._bytes.total()

    def begin_upload(self, name: str) -> None:
        """Count a photograph of the key ``name``.

        Raises
        ------
        HTTPException
            429 if the key already sends the largest number of photographs allowed.
        """
        most = self._settings.max_uploads_of_key
        if self._uploads[name] >= most:
            raise _too_many(
                f"key {name} sends {most} photographs at a time already; wait until some are"
                " answered"
            )
        self._uploads[name] += 1

    def add(self, name: str, size: int) -> None:
        """Count ``size`` more bytes of the key ``name``.

        Raises
        ------
        HTTPException
            429 if the key holds too many bytes, 503 if the service does.
        """
        settings = self._settings
        if self._bytes[name] + size > settings.max_body_bytes_of_key:
            raise _too_many(
                f"key {name} has sent {settings.max_body_bytes_of_key} bytes that are not answered"
                " yet; wait until some are"
            )
        if self.held_bytes() + size > settings.max_body_bytes:
            detail = (
                "the bodies of other requests use all space; send this one again as"
                " Retry-After says"
            )
            raise HTTPException(HTTPStatus.SERVICE_UNAVAILABLE, detail, {"Retry-After": "5"})
        self._bytes[name] += size


def _too_many(detail: str) -> HTTPException:
    return HTTPException(HTTPStatus.TOO_MANY_REQUESTS, detail, {"Retry-After": "5"})


class HeldBody:
    """The counted part of one request body."""

    def __init__(self, limiter: BodyLimiter, name: str) -> None:
        self._limiter = limiter
        self._name = name
        self.size = 0
        self.is_upload = False

    def begin_upload(self) -> None:
        """Count the body as a photograph (`BodyLimiter.begin_upload`)."""
        self._limiter.begin_upload(self._name)
        self.is_upload = True

    def grow_to(self, size: int) -> None:
        """Count the body with ``size`` bytes, received or announced (`BodyLimiter.add`)."""
        if size > self.size:
            self._limiter.add(self._name, size - self.size)
            self.size = size
