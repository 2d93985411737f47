"""Middleware for every request.

It adds a request id, a log line and security headers, checks the key, and limits the body and the
time to stop.
"""

import asyncio
import logging
import math
import re
import threading
import time
import uuid
from functools import partial
from http import HTTPStatus
from typing import NamedTuple

from anyio import CancelScope, CapacityLimiter, move_on_after, to_thread
from fastapi import HTTPException, Response
from sqlalchemy.exc import OperationalError
from sqlalchemy.exc import TimeoutError as PoolTimeoutError
from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.base import monitoring
from service.base.monitoring import REQUEST_SECONDS, REQUESTS
from service.base.settings import Settings
from service.store.keys import record_use
from service.twin.slots import STOPPING, as_caller
from service.web.auth import security
from service.web.auth.dependencies import takes_archive, takes_upload
from service.web.auth.limiters import RateLimiter, sender_of
from service.web.auth.request_checks import BodyLimiter, HeldBody, JsonShape
from service.web.responses import pages, problems
from service.web.responses.pages import take_part
from service.web.responses.problems import SECURITY_HEADERS, problem

logger = logging.getLogger("heliotwin.access")

_REQUEST_ID = re.compile(r"[A-Za-z0-9_-]{8,64}")
# Methods with a separate label in metrics, and frequent paths that are logged at debug level.
_METHODS = ("GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS")
_PROBES = ("/livez", "/readyz", "/metrics")
# Bytes of a response that cost as much as a request. A map of 1024 x 1024 as JSON costs about 300.
_BYTES_A_TOKEN = 64 * 1024
# Largest body on a public path [bytes], and its only media type: a form with a key.
_PUBLIC_BYTES = 4096
_FORM = "application/x-www-form-urlencoded"
# Time to finish requests during shutdown, and interval between checks [s].
_FINISH_S = 5.0
_LOOK_EVERY_S = 0.25
# Longest pause before the next part of a body [s].
_BODY_PAUSE_S = 30.0
# Size that multipart boundaries, part headers and the metadata may add to an image [bytes].
_MULTIPART_OVERHEAD = 64 * 1024


class _Middleware:
    """Base of middleware that has no settings."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app


class RequestIdMiddleware(_Middleware):
    """Middleware that assigns an id to every request and logs it.

    A well-formed id from the client is used. The response has the id, too.
    """

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

        with monitoring.log_context(request_id=identity):
            await self.app(scope, receive, send_with_id)


def _note(scope: Scope, method: str, status: int, took_s: float) -> None:
    """Log and count a request."""
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
    """The path template of the route, such as ``/v1/heliostats/{name}``; "none" without a route."""
    path: str | None = getattr(scope.get("route"), "path", None)
    if path is None:
        return "none"
    # A route of an included router reports only its path within the router.
    return path if not scope["path"].startswith("/v1/") or path.startswith("/v1/") else f"/v1{path}"


class HeadMiddleware(_Middleware):
    """Middleware that answers HEAD like GET, without the body.

    A streamed response, such as events, is cancelled after its headers.
    """

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

        # Change the scope itself, because the server and the log read it. The server must see HEAD
        # again afterwards.
        scope["method"] = "GET"
        try:
            with making:
                await self.app(scope, receive, send_head)
        finally:
            scope["method"] = "HEAD"


class PartMiddleware(_Middleware):
    """Middleware that moves the requested part of a page from the query to the request state."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """One ASGI call."""
        if scope["type"] == "http":
            take_part(scope)
        await self.app(scope, receive, send)


class SecurityHeadersMiddleware(_Middleware):
    """Middleware that adds security headers.

    Browsers then load nothing from other origins, guess no media types, and show no page in a
    frame of another site.
    """

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """One ASGI call."""

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in SECURITY_HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        await self.app(scope, receive, send_with_headers)


class _Bucket(NamedTuple):
    """A rate limiter, and the name of a bucket in it."""

    limiter: RateLimiter
    name: str


class AuthMiddleware:
    """Middleware that identifies the sender before the body is read.

    It refuses unknown senders, and stores the `service.web.auth.security.Identity` in the request
    state. Each key may send requests at the rate of the settings. Failed attempts count in a
    separate bucket of the client address. They block neither public paths nor probes, which have no
    rate limit.
    """

    def __init__(self, app: ASGIApp, settings: Settings) -> None:
        self.app = app
        self.settings = settings
        self.of_keys = RateLimiter(settings.requests_per_s, settings.requests_burst)
        self.of_addresses = RateLimiter(
            settings.public_requests_per_s, settings.public_requests_burst
        )
        # Separate threads, so that keys are checked even while predictions take all others.
        self.threads = CapacityLimiter(8)
        self.recording: set[int] = set()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """One ASGI call."""
        if scope["type"] == "http":
            refusal = await self._refusal(scope)
            if refusal is not None:
                await refusal(scope, receive, send)
                return
            identity = scope.get("state", {}).get("identity")
            with as_caller("" if identity is None else identity.name):
                await self.app(scope, receive, self._charging(scope, send))
            await self._record_use(scope, identity)
            return
        await self.app(scope, receive, send)

    async def _record_use(self, scope: Scope, identity: security.Identity | None) -> None:
        """Record the use of a key after the response, by one request at a time."""
        key = None if identity is None else identity.unrecorded
        if key is None or key in self.recording:
            return
        self.recording.add(key)
        try:
            await to_thread.run_sync(record_use, scope["app"].state.runtime.database, key)
        except (OperationalError, PoolTimeoutError) as error:  # a later request does
            logger.warning("the use of a key is not recorded: %s", error)
        finally:
            self.recording.discard(key)

    def _charging(self, scope: Scope, send: Send) -> Send:
        """Wrap ``send`` so that the sender pays for the response by its size."""
        buckets, name = self._bucket(scope)
        paid = _BYTES_A_TOKEN  # the token of the request covers the first bytes

        async def charging(message: Message) -> None:
            nonlocal paid
            size = len(message.get("body", b""))
            if size > paid:
                buckets.charge(name, (size - paid) / _BYTES_A_TOKEN)
            paid = max(0, paid - size)
            await send(message)

        return charging

    async def _refusal(self, scope: Scope) -> Response | None:
        headers = Headers(scope=scope)
        if scope["method"] not in ("GET", "HEAD", "OPTIONS") and _is_cross_site(headers):
            return problem(
                scope, HTTPStatus.FORBIDDEN, "another site's page may not change anything here"
            )
        identity = None
        if not security.is_public(scope["path"]):
            try:
                identity = await self._identify(scope, headers)
            except (OperationalError, PoolTimeoutError) as error:
                return problems.database_away(scope, error)
        if identity == security.LOCAL and not self.settings.is_own_host(headers.get("host", "")):
            detail = (
                "Host: no name of this service; use its address, add the name to"
                " HELIOTWIN_ALLOWED_HOSTS, or a key"
            )
            return problem(scope, HTTPStatus.MISDIRECTED_REQUEST, detail)
        return self._too_often(scope) or self._unknown(scope, identity)

    async def _identify(self, scope: Scope, headers: Headers) -> security.Identity | None:
        database, presented = scope["app"].state.runtime.database, security.presented_key(headers)
        # Proxies that add no header often speak HTTP/1.0 to the service. Clients do not.
        is_direct = not security.is_forwarded(headers) and scope.get("http_version") != "1.0"
        asked = partial(security.identify, database, self.settings, presented, is_direct)
        identity = await to_thread.run_sync(asked, limiter=self.threads)
        scope.setdefault("state", {})["identity"] = identity
        return identity

    def _too_often(self, scope: Scope) -> Response | None:
        if scope["path"] in security.HEALTH:
            return None
        buckets, name = self._bucket(scope)
        wait_s = buckets.wait_s(name)
        if not wait_s:
            return None
        headers = {"Retry-After": str(math.ceil(wait_s))}
        return problem(
            scope,
            HTTPStatus.TOO_MANY_REQUESTS,
            "too many requests; wait as Retry-After says",
            headers,
        )

    def _bucket(self, scope: Scope) -> _Bucket:
        """The bucket of a request.

        It belongs to the key, to the address, or to wrong keys of that address.
        """
        identity, client = scope.get("state", {}).get("identity"), scope.get("client")
        if identity is not None:
            return _Bucket(self.of_keys, identity.name)
        address = sender_of(client[0]) if client else ""
        is_public = security.is_public(scope["path"])
        return _Bucket(self.of_addresses, address if is_public else f"wrong keys of {address}")

    def _unknown(self, scope: Scope, identity: security.Identity | None) -> Response | None:
        if identity is not None or security.is_public(scope["path"]):
            return None
        if pages.wants_page(scope) and scope["method"] == "GET":
            return self._login(scope)
        detail = "present a valid key: Authorization: Bearer KEY; `heliotwin keys create` makes one"
        return problem(scope, HTTPStatus.UNAUTHORIZED, detail, {"WWW-Authenticate": "Bearer"})

    def _login(self, scope: Scope) -> Response:
        """Send a browser to the login page.

        htmx gets a header instead, because it would show the login page inside the current one.
        """
        path = pages.login_path(scope)
        if "hx-request" in Headers(scope=scope):
            return Response(status_code=HTTPStatus.UNAUTHORIZED, headers={"HX-Redirect": path})
        return pages.go_to(path)


def _is_cross_site(headers: Headers) -> bool:
    """Whether the browser reports that another origin sent the request.

    Other clients send no such header.
    """
    fetched = headers.get("sec-fetch-site")
    if fetched is not None:
        return fetched not in ("same-origin", "none")
    origin = headers.get("origin")
    return origin is not None and origin.partition("://")[2] != headers.get("host")


class StoppingMiddleware(_Middleware):
    """Middleware that answers 503 if a route takes too long during shutdown.

    A thread that runs the model cannot be ended. It is abandoned, its result is lost, and the
    process ends without it.
    """

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
                await (
                    work  # a started response is sent completely, while the server waits
                )
                return
        finally:
            work.cancel()
        runtime = scope["app"].state.runtime
        runtime.compute_slots.close()
        runtime.decoding_slots.close()
        runtime.large_image_slots.close()
        logger.warning(
            "%s %s is not done in time: the service stops", scope["method"], scope["path"]
        )
        await problem(scope, HTTPStatus.SERVICE_UNAVAILABLE, STOPPING, {"Retry-After": "10"})(
            scope, receive, send
        )


async def _until_done_or_late(work: asyncio.Future[None], stopping: threading.Event) -> None:
    """Wait until ``work`` is done, or for a short time after ``stopping`` is set."""
    while not stopping.is_set():
        done, _ = await asyncio.wait({work}, timeout=_LOOK_EVERY_S)
        if done:
            return
    await asyncio.wait({work}, timeout=_FINISH_S)


class BodyLimitMiddleware:
    """Middleware that limits request bodies, and checks the role before it reads them.

    The role is checked before the first byte is read. A body that is too large is refused at once
    if its length is announced, else when it exceeds the limit. A request without a key may send
    only a small form.

    Each part must arrive within a fixed time. The whole body has that time once, and additionally
    the time of the received bytes at the minimum rate of the settings. `BodyLimiter` limits the
    bytes of a key that are not answered yet.
    """

    def __init__(self, app: ASGIApp, settings: Settings, limiter: BodyLimiter) -> None:
        self.app = app
        self.settings = settings
        self.limiter = limiter
        self.timeout_s = _BODY_PAUSE_S

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """One ASGI call."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        limit = self._largest(scope, headers)
        announced = headers.get("content-length", "0")
        size = int(announced[:20]) if announced.isdecimal() else 0
        if size > limit:
            await problem(scope, HTTPStatus.REQUEST_ENTITY_TOO_LARGE, _larger_than(limit))(
                scope, receive, send
            )
            return
        if (
            security.is_public(scope["path"])
            and headers.get("content-type", _FORM).partition(";")[0].strip() != _FORM
        ):
            refused = f"Content-Type: send {_FORM}"
            await problem(scope, HTTPStatus.UNSUPPORTED_MEDIA_TYPE, refused)(scope, receive, send)
            return
        identity = scope.get("state", {}).get("identity")
        with self.limiter.body("" if identity is None else identity.name) as held:
            bounded = _BoundedBody(self, scope, receive, held, size)
            await self.app(scope, bounded.receive, send)

    def _largest(self, scope: Scope, headers: Headers) -> int:
        """Largest body of this kind that any route accepts [bytes]."""
        if security.is_public(scope["path"]):
            return _PUBLIC_BYTES
        settings = self.settings
        return settings.max_body_bytes_of_key if _is_upload(headers) else settings.max_json_bytes

    @property
    def largest_upload(self) -> int:
        """Largest form of a photograph [bytes]."""
        return self.settings.max_image_bytes + _MULTIPART_OVERHEAD


def _is_upload(headers: Headers) -> bool:
    return headers.get("content-type", "").lower().startswith("multipart/form-data")


def _larger_than(limit: int) -> str:
    return f"body: larger than the {limit} bytes allowed; send less"


class _BoundedBody:
    """The body of one request as its route receives it.

    It raises HTTPException, which routes do not catch.
    """

    def __init__(
        self,
        bounds: BodyLimitMiddleware,
        scope: Scope,
        receive: Receive,
        held: HeldBody,
        announced: int,
    ) -> None:
        self._bounds = bounds
        self._scope = scope
        self._receive = receive
        self._held = held
        self._announced = announced
        self._received = 0
        self._waited_s = 0.0
        self._is_begun = self._is_whole = False
        self._limit = 0
        self._shape: JsonShape | None = None

    async def receive(self) -> Message:
        """Return the next part."""
        if not self._is_begun:
            self._begin()
        message = await self._next()
        part = message.get("body", b"")
        self._is_whole = not message.get("more_body", False)
        self._received += len(part)
        if self._received > self._limit:
            raise HTTPException(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, _larger_than(self._limit))
        self._held.grow_to(self._received)
        if self._shape is not None:
            self._shape.add(part)
        return message

    def _begin(self) -> None:
        """Check the role, and choose the limits of the route. The route is known only now."""
        self._is_begun = True
        route, headers = self._scope.get("route"), Headers(scope=self._scope)
        security.require_role(self._scope.get("state", {}).get("identity"), security.role_of(route))
        takes_file, settings = takes_upload(route), self._bounds.settings
        is_public = security.is_public(self._scope["path"])
        rest = _PUBLIC_BYTES if is_public else settings.max_json_bytes
        photograph, archive = self._bounds.largest_upload, settings.max_body_bytes_of_key
        largest = archive if takes_archive(route) else photograph
        self._limit = largest if takes_file and _is_upload(headers) else rest
        if self._announced > self._limit:
            raise HTTPException(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, _larger_than(self._limit))
        if takes_file:
            self._held.begin_upload()
        elif "json" in headers.get("content-type", ""):
            self._shape = JsonShape()
        self._held.grow_to(self._announced)

    async def _next(self) -> Message:
        # Only the time of the sender counts, not the time of the service between two parts.
        timeout_s, rate = self._bounds.timeout_s, self._bounds.settings.min_bytes_per_s
        left_s = min(timeout_s, timeout_s + self._received / rate - self._waited_s)
        began = time.monotonic()
        # After the body, the only remaining message is the disconnect, which has no timeout.
        with move_on_after(None if self._is_whole else left_s) as waiting:
            message = await self._receive()
        self._waited_s += time.monotonic() - began
        if waiting.cancelled_caught:
            raise HTTPException(
                HTTPStatus.REQUEST_TIMEOUT, "body: it did not come in time; send it again"
            )
        return message
