"""What stands before every route: a request id, a log line, headers for browsers, the door, bounds on body and end."""

import asyncio
import logging
import math
import re
import threading
import time
import uuid
from functools import partial
from http import HTTPStatus
from urllib.parse import urlsplit

from anyio import CancelScope, CapacityLimiter, move_on_after, to_thread
from fastapi import HTTPException, Response
from sqlalchemy.exc import OperationalError
from sqlalchemy.exc import TimeoutError as PoolTimeoutError
from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.base import logs
from service.base.meters import REQUEST_SECONDS, REQUESTS
from service.base.settings import Settings, is_loopback
from service.twin.gate import STOPPING
from service.web.answers import pages, problems
from service.web.answers.parts import take_part
from service.web.answers.problems import SECURITY_HEADERS, problem
from service.web.door import security
from service.web.door.limits import Buckets

logger = logging.getLogger("heliotwin.access")

_REQUEST_ID = re.compile(r"[A-Za-z0-9_-]{8,64}")
# Methods that are told apart in metrics, and paths that are asked for too often to log each time.
_METHODS = ("GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS")
_PROBES = ("/livez", "/readyz", "/metrics")
# Bytes of an answer that count as another request: a map of 1024 x 1024 as JSON counts as some three hundred.
_BYTES_A_TOKEN = 64 * 1024
# Largest body where no key is needed [bytes], and its only media type: a form with a key.
_PUBLIC_BYTES = 4096
_FORM = "application/x-www-form-urlencoded"
# Time that requests get to be done when the service is told to stop, and how often they look whether it was [s].
_FINISH_S = 5.0
_LOOK_EVERY_S = 0.25
# Longest pause before the next part of a body [s].
_BODY_PAUSE_S = 30.0
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
        identity = given if _REQUEST_ID.fullmatch(given) else uuid.uuid4().hex
        scope.setdefault("state", {})["request_id"] = identity
        method, started = scope["method"], time.perf_counter()

        async def send_with_id(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message)["X-Request-ID"] = identity
                _note(scope, method, message["status"], time.perf_counter() - started)
            await send(message)

        with logs.bound(request_id=identity):
            await self.app(scope, receive, send_with_id)


def _note(scope: Scope, method: str, status: int, took_s: float) -> None:
    """Log a request and count it."""
    path, identity = scope["path"], scope["state"].get("identity")
    level = logging.DEBUG if path in _PROBES else logging.INFO
    extra = {"method": method, "path": path, "status": status, "ms": round(took_s * 1e3, 1)}
    extra["key"] = None if identity is None else identity.name
    logger.log(level, "%s %s %d %.1f ms", method, path, status, took_s * 1e3, extra=extra)
    known = method if method in _METHODS else "other"
    route = _template(scope)
    REQUESTS.labels(known, route, status).inc()
    REQUEST_SECONDS.labels(known, route).observe(took_s)


def _template(scope: Scope) -> str:
    """The path as its route declares it, ``/v1/heliostats/{name}``; "none" where there is no route."""
    path: str | None = getattr(scope.get("route"), "path", None)
    if path is None:
        return "none"
    # A router that was included tells its own path only.
    return path if not scope["path"].startswith("/v1/") or path.startswith("/v1/") else f"/v1{path}"


class HeadMiddleware:
    """Answers HEAD as GET, without the body; what is made part by part, such as events, ends with its head."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """One ASGI call."""
        if scope["type"] != "http" or scope["method"] != "HEAD":
            await self.app(scope, receive, send)
            return
        making = CancelScope()

        async def send_head(message: Message) -> None:
            if message["type"] != "http.response.body":
                await send(message)
                return
            await send({"type": "http.response.body", "body": b"", "more_body": False})
            if message.get("more_body", False):
                making.cancel()

        # The scope itself, for the server and the log look into it; the server must know again what it answers.
        scope["method"] = "GET"
        try:
            with making:
                await self.app(scope, receive, send_head)
        finally:
            scope["method"] = "HEAD"


class PartMiddleware:
    """Takes from a page's query which part of it is asked for as a file."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """One ASGI call."""
        if scope["type"] == "http":
            take_part(scope)
        await self.app(scope, receive, send)


class SecurityHeadersMiddleware:
    """Tells browsers to load nothing from elsewhere, to guess no types and to show nothing in foreign frames."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """One ASGI call."""

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in SECURITY_HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        await self.app(scope, receive, send_with_headers)


class DoorMiddleware:
    """Finds out who asks, before anything of the body is read, and turns away who may not come in.

    The request's `service.web.door.security.Identity` is left in its state for the routes. Whoever may come in is
    let in as often as the settings allow. Attempts that fail count for the client's address in a bucket of their own:
    they shut out neither what is public nor supervisors, who are never refused for asking too often.
    """

    def __init__(self, app: ASGIApp, settings: Settings) -> None:
        self.app = app
        self.settings = settings
        self.buckets = Buckets(settings.requests_per_s, settings.requests_burst)
        # Its own threads: a service that is busy with predictions still knows its keys.
        self.threads = CapacityLimiter(8)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """One ASGI call."""
        if scope["type"] == "http":
            refusal = await self._refusal(scope)
            if refusal is not None:
                await refusal(scope, receive, send)
                return
            send = self._charging(scope, send)
        await self.app(scope, receive, send)

    def _charging(self, scope: Scope, send: Send) -> Send:
        """The same ``send``, which charges whoever asked for what is sent, so that large answers cost what they are."""
        bucket, paid = _bucket(scope), _BYTES_A_TOKEN  # the request's own token pays for the first ones

        async def charging(message: Message) -> None:
            nonlocal paid
            size = len(message.get("body", b""))
            if size > paid:
                self.buckets.charge(bucket, (size - paid) / _BYTES_A_TOKEN)
            paid = max(0, paid - size)
            await send(message)

        return charging

    async def _refusal(self, scope: Scope) -> Response | None:
        headers = Headers(scope=scope)
        if scope["method"] not in ("GET", "HEAD", "OPTIONS") and _is_cross_site(headers):
            return problem(scope, HTTPStatus.FORBIDDEN, "another site's page may not change anything here")
        identity = None
        if not security.is_public(scope["path"]):
            try:
                identity = await self._identify(scope, headers)
            except (OperationalError, PoolTimeoutError) as error:
                return problems.database_away(scope, error)
        if identity == security.LOCAL and self._is_rebound(headers):
            return problem(scope, HTTPStatus.FORBIDDEN, "Host: without a key use one of this machine's own names")
        return self._too_often(scope) or self._unknown(scope, identity)

    def _is_rebound(self, headers: Headers) -> bool:
        """Whether a page may have reached this machine by a name that its owner lets point here (DNS rebinding)."""
        return is_loopback(self.settings.host) and not _is_loopback_name(headers.get("host", ""))

    async def _identify(self, scope: Scope, headers: Headers) -> security.Identity | None:
        database, presented = scope["app"].state.runtime.database, security.presented_key(headers)
        # Proxies of the sort that adds no header often speak HTTP/1.0 to what stands behind them, which clients do not.
        is_direct = not security.is_forwarded(headers) and scope.get("http_version") != "1.0"
        asked = partial(security.identify, database, self.settings, presented, is_direct)
        identity = await to_thread.run_sync(asked, limiter=self.threads)
        scope.setdefault("state", {})["identity"] = identity
        return identity

    def _too_often(self, scope: Scope) -> Response | None:
        if scope["path"] in security.HEALTH:
            return None
        wait_s = self.buckets.wait_s(_bucket(scope))
        if not wait_s:
            return None
        headers = {"Retry-After": str(math.ceil(wait_s))}
        return problem(scope, HTTPStatus.TOO_MANY_REQUESTS, "too many requests; wait as Retry-After says", headers)

    def _unknown(self, scope: Scope, identity: security.Identity | None) -> Response | None:
        if identity is not None or security.is_public(scope["path"]):
            return None
        if pages.wants_page(scope) and scope["method"] == "GET":
            return self._login(scope)
        detail = "present a valid key: Authorization: Bearer KEY; `heliotwin keys create` makes one"
        return problem(scope, HTTPStatus.UNAUTHORIZED, detail, {"WWW-Authenticate": "Bearer"})

    def _login(self, scope: Scope) -> Response:
        """A browser is sent to the page for keys; htmx, which would show that page inside of another, goes there."""
        path = pages.login_path(scope)
        if "hx-request" in Headers(scope=scope):
            return Response(status_code=HTTPStatus.UNAUTHORIZED, headers={"HX-Redirect": path})
        return pages.go_to(path)


def _bucket(scope: Scope) -> str:
    """The name of the bucket that a request takes from: its key's, its address's, or its address's for failures."""
    identity, client = scope.get("state", {}).get("identity"), scope.get("client")
    if identity is not None:
        return f"key {identity.name}"
    address = client[0] if client else ""
    return f"address {address}" if security.is_public(scope["path"]) else f"failures of {address}"


def _is_loopback_name(host: str) -> bool:
    try:
        return is_loopback(urlsplit(f"//{host}").hostname or "")
    except ValueError:
        return False


def _is_cross_site(headers: Headers) -> bool:
    """Whether a browser says that the request comes from a page of another origin; other clients say nothing."""
    fetched = headers.get("sec-fetch-site")
    if fetched is not None:
        return fetched not in ("same-origin", "none")
    origin = headers.get("origin")
    return origin is not None and origin.partition("://")[2] != headers.get("host")


class StoppingMiddleware:
    """Answers 503 where a route does not answer soon after the service was told to stop.

    A thread at the model cannot be ended: it is left behind, what it finds is not kept, the process ends without it.
    """

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """One ASGI call."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        has_begun = False

        async def noting(message: Message) -> None:
            nonlocal has_begun
            has_begun = True
            await send(message)

        work = asyncio.ensure_future(self.app(scope, receive, noting))
        try:
            await _until_done_or_late(work, scope["app"].state.stopping)
            if work.done() or has_begun:
                await work  # an answer that has begun is sent to its end, as long as the server waits
                return
        finally:
            work.cancel()
        scope["app"].state.runtime.gate.close()
        logger.warning("%s %s is not done in time: the service stops", scope["method"], scope["path"])
        await problem(scope, HTTPStatus.SERVICE_UNAVAILABLE, STOPPING, {"Retry-After": "10"})(scope, receive, send)


async def _until_done_or_late(work: asyncio.Future[None], stopping: threading.Event) -> None:
    """Until the work is done, or was not soon after ``stopping``."""
    while not stopping.is_set():
        done, _ = await asyncio.wait({work}, timeout=_LOOK_EVERY_S)
        if done:
            return
    await asyncio.wait({work}, timeout=_FINISH_S)


class BodyLimitMiddleware:
    """Stops reading a body at its bound: at once where its length is announced, else when the bound is passed.

    Who comes without a key may send a small form and nothing else. No part of a body may be long in coming, and the
    whole has that pause once and then as long as the settings' least rate gives what has come.
    """

    def __init__(self, app: ASGIApp, settings: Settings) -> None:
        self.app = app
        self.settings = settings
        self.patience_s = _BODY_PAUSE_S

    def _limit(self, scope: Scope, headers: Headers) -> int:
        if security.is_public(scope["path"]):
            return _PUBLIC_BYTES
        if headers.get("content-type", "").lower().startswith("multipart/form-data"):
            return self.settings.max_image_bytes + _MULTIPART_OVERHEAD
        return self.settings.max_json_bytes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """One ASGI call."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        limit = self._limit(scope, headers)
        detail = f"body: larger than the {limit} bytes allowed; send less"
        announced = headers.get("content-length", "0")
        if announced.isdecimal() and int(announced[:20]) > limit:
            await problem(scope, HTTPStatus.REQUEST_ENTITY_TOO_LARGE, detail)(scope, receive, send)
            return
        if security.is_public(scope["path"]) and headers.get("content-type", _FORM).partition(";")[0].strip() != _FORM:
            refused = f"Content-Type: send {_FORM}"
            await problem(scope, HTTPStatus.UNSUPPORTED_MEDIA_TYPE, refused)(scope, receive, send)
            return
        received, waited_s, is_whole = 0, 0.0, False

        async def bounded() -> Message:
            nonlocal received, waited_s, is_whole
            # What the service itself takes between two parts is not the sender's.
            left_s = min(self.patience_s, self.patience_s + received / self.settings.least_bytes_per_s - waited_s)
            began = time.monotonic()
            # After the body only the client's going is waited for, however long that takes.
            with move_on_after(None if is_whole else left_s) as waiting:
                message = await receive()
            waited_s += time.monotonic() - began
            if waiting.cancelled_caught:
                raise HTTPException(HTTPStatus.REQUEST_TIMEOUT, "body: it did not come in time; send it again")
            is_whole = not message.get("more_body", False)
            received += len(message.get("body", b""))
            if received > limit:
                raise HTTPException(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, detail)
            return message

        await self.app(scope, bounded, send)
