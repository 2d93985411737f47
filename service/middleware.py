"""What stands before every route: a request id, a log line, and a bound on the body."""

import logging
import re
import time
import uuid
from http import HTTPStatus

from fastapi import HTTPException
from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.errors import problem
from service.settings import Settings

logger = logging.getLogger("heliotwin.access")

_REQUEST_ID = re.compile(r"^[A-Za-z0-9_-]{8,64}$")
# What multipart boundaries, part headers and the metadata may add to an image [bytes].
_MULTIPART_OVERHEAD = 64 * 1024


class RequestIdMiddleware:
    """Gives every request an id, the caller's where it is well-formed, sends it back and logs the request with it."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """One ASGI call."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        given = Headers(scope=scope).get("x-request-id", "")
        identity = given if _REQUEST_ID.match(given) else uuid.uuid4().hex
        scope.setdefault("state", {})["request_id"] = identity
        started = time.perf_counter()

        async def send_with_id(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message)["X-Request-ID"] = identity
                took = (time.perf_counter() - started) * 1e3
                path = scope["path"].encode("unicode_escape").decode()
                logger.info("%s %s %s %d %.1f ms", identity, scope["method"], path, message["status"], took)
            await send(message)

        await self.app(scope, receive, send_with_id)


class BodyLimitMiddleware:
    """Stops reading a body at its bound: at once where its length is announced, else when the bound is passed."""

    def __init__(self, app: ASGIApp, settings: Settings) -> None:
        self.app = app
        self.settings = settings

    def _limit(self, headers: Headers) -> int:
        if headers.get("content-type", "").lower().startswith("multipart/form-data"):
            return self.settings.max_image_bytes + _MULTIPART_OVERHEAD
        return self.settings.max_json_bytes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """One ASGI call."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        limit = self._limit(headers)
        detail = f"body: larger than the {limit} bytes allowed; send less"
        announced = headers.get("content-length", "0")
        if announced.isdecimal() and int(announced[:20]) > limit:
            await problem(scope, HTTPStatus.REQUEST_ENTITY_TOO_LARGE, detail)(scope, receive, send)
            return
        received = 0

        async def bounded() -> Message:
            nonlocal received
            message = await receive()
            received += len(message.get("body", b""))
            if received > limit:
                raise HTTPException(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, detail)
            return message

        await self.app(scope, bounded, send)
