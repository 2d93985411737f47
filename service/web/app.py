"""The FastAPI application, built from the settings, and its server, for the command ``serve``."""

import socket
import threading
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from importlib.metadata import PackageNotFoundError, version
from types import FrameType

import uvicorn
from anyio import to_thread
from fastapi import APIRouter, Depends, FastAPI
from fastapi.routing import APIRoute
from starlette.routing import BaseRoute

from service.base import monitoring, processes
from service.base.discovery import modules_of
from service.base.errors import NotStartedError
from service.base.monitoring import serve_metrics
from service.base.settings import Settings
from service.jobs.kind import Kinds
from service.jobs.kinds import KINDS
from service.jobs.uploads import delete_unused_uploads
from service.jobs.worker import Workers
from service.store.database import Database
from service.twin.alarms.field_overview import FieldOverviewCache
from service.twin.alarms.reasons import AlarmCount
from service.twin.runtime import Operations, Runtime
from service.twin.slots import MAX_WAITING
from service.twin.surfaces.accuracy import ComparisonCache
from service.web.auth import security
from service.web.auth.dependencies import require_unique_keys
from service.web.auth.limiters import FairLimiter, protocol_of
from service.web.auth.request_checks import BodyLimiter, require_known_query
from service.web.middleware import (
    AuthMiddleware,
    BodyLimitMiddleware,
    HeadMiddleware,
    PartMiddleware,
    RequestIdMiddleware,
    SecurityHeadersMiddleware,
    StoppingMiddleware,
)
from service.web.resources import jobs
from service.web.responses import openapi, problems
from service.web.responses.job_events import Watchers
from service.web.root.health import SharedCheck
from service.web.store_metrics import registry

_DESCRIPTION = (
    "Post the target photographs of a solar tower, read back each heliostat's flux and surface, and"
    " forecast the flux that it throws on any plane. Metres, degrees where a name says so,"
    " east-north-up from the tower base. HEAD is answered wherever GET is."
)


def _version() -> str:
    try:
        return version("heliotwin")
    except PackageNotFoundError:  # run from a checkout that is not installed
        return "0"


def _operation_id(route: APIRoute) -> str:
    return route.name


def require_fit(settings: Settings, database: Database) -> None:
    """Check that the service may start, and migrate an embedded store.

    Raises
    ------
    SchemaError
        If the store is not at the newest version and is not migrated automatically.
    UnauthenticatedExposureError
        If other machines can connect and no key exists.
    """
    if settings.migrates_on_start:
        database.upgrade()
    database.require_current()
    security.refuse_unauthenticated_exposure(settings, database)


def collect_routes(kinds: Kinds) -> list[BaseRoute]:
    """Collect the routes of the API, the pages and the paths next to them."""
    root = APIRouter(generate_unique_id_function=_operation_id)
    v1 = APIRouter(
        prefix="/v1", dependencies=[Depends(require_known_query), Depends(require_unique_keys)]
    )
    v1.include_router(
        jobs.creators(kinds)
    )  # before the routes of a job, which would read the names of kinds as numbers
    resources = modules_of("service.web.resources")
    for resource in resources:
        if hasattr(resource, "router"):
            v1.include_router(resource.router)
    root.include_router(v1)
    for resource in resources:
        if hasattr(resource, "pages"):
            root.include_router(resource.pages)
    for place in (*modules_of("service.web.root"), *modules_of("service.web.pages")):
        if hasattr(place, "router"):
            root.include_router(place.router)
        for path, static_files in getattr(place, "MOUNTS", {}).items():
            root.mount(path, static_files)  # the page in the router takes precedence
    return root.routes


def create_app(
    settings: Settings, operations: Operations | None = None, kinds: Kinds = KINDS
) -> FastAPI:
    """Create the application for these settings.

    ``operations`` replaces the model (`service.twin.operations`) in tests. The store is
    opened when the application starts, and an embedded SQLite store is migrated. The application
    does not start if `require_fit` raises. It accepts jobs of ``kinds``, and runs them if the
    settings say so.
    """

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        runtime = await to_thread.run_sync(Runtime.from_settings, settings, operations)
        try:
            await to_thread.run_sync(require_fit, settings, runtime.database)
            await to_thread.run_sync(delete_unused_uploads, runtime)
            app.state.runtime = runtime.for_requests()
            app.state.field = FieldOverviewCache(runtime)
            app.state.alarms = AlarmCount()
            app.state.watchers = Watchers(runtime)
            app.state.comparisons = ComparisonCache(runtime)
            workers = Workers(runtime, kinds, settings.job_workers)
            workers.start()
            try:
                with serve_metrics(settings, registry(runtime, app.state.field)):
                    yield
            finally:
                await to_thread.run_sync(workers.stop)
                await to_thread.run_sync(app.state.field.close)
                await to_thread.run_sync(app.state.comparisons.close)
        finally:
            runtime.close()

    app = FastAPI(
        title="heliotwin",
        version=_version(),
        description=_DESCRIPTION,
        lifespan=lifespan,
        routes=collect_routes(kinds),
        redirect_slashes=False,
        docs_url=None,  # service.web.root.documentation serves its own page
        redoc_url=None,
    )
    app.state.stopping = threading.Event()
    app.state.readiness = SharedCheck()
    app.state.render_limiter = FairLimiter()
    app.state.overview_limiter = FairLimiter()
    app.state.kinds = kinds
    app.state.bodies = BodyLimiter(settings)
    app.state.compute_limiter = FairLimiter(
        settings.parallel_computations + MAX_WAITING
    )  # as many as the compute slots of the model accept
    security.require_declared_roles(app)
    problems.install(app)
    openapi.install(app)
    app.add_middleware(PartMiddleware)
    app.add_middleware(StoppingMiddleware)
    app.add_middleware(BodyLimitMiddleware, settings=settings, limiter=app.state.bodies)
    app.add_middleware(AuthMiddleware, settings=settings)
    app.add_middleware(HeadMiddleware)
    app.add_middleware(SecurityHeadersMiddleware)
    app.add_middleware(RequestIdMiddleware)  # the middleware that is added last runs first
    return app


# Time to finish responses that have begun, after the signal to stop [s].
# `service.web.middleware.StoppingMiddleware` answers all other requests before. Jobs get another 20
# s. Process supervisors usually wait 30 to 40 s.
_GRACE_S = 10

# Time that an idle connection stays open [s]. Clients and proxies usually keep one for less.
_KEEP_ALIVE_S = 75

# Largest head of a request [bytes].
_MAX_HEAD_BYTES = 32 * 1024


class _Server(uvicorn.Server):
    """Server that reports when it listens, and sets ``stopping`` when it must stop.

    Responses without an end use ``stopping`` to end.
    """

    def __init__(
        self, config: uvicorn.Config, stopping: threading.Event, on_listening: Callable[[], None]
    ) -> None:
        super().__init__(config)
        self._stopping = stopping
        self._on_listening = on_listening

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start the application, then listen."""
        await super().startup(sockets)
        self._on_listening()

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Handle SIGTERM or SIGINT."""
        self._stopping.set()
        super().handle_exit(sig, frame)


def serve(settings: Settings, on_listening: Callable[[], None] = lambda: None) -> None:
    """Run the service until a signal stops it. An embedded SQLite store is migrated first.

    ``on_listening`` is called when the service can answer requests.

    Raises
    ------
    NotStartedError
        If the port or the application prevents the start.
    SchemaError, UnauthenticatedExposureError
        From `require_fit`.
    """
    processes.limit_memory()
    monitoring.configure_logging(settings)
    monitoring.configure_tracing(settings, "heliotwin")
    _require_fit(settings)
    app = create_app(settings)
    config = config_of(settings, app)
    server = _Server(config, app.state.stopping, on_listening)
    try:
        with processes.returning_memory():
            server.run()
    except SystemExit as refusal:  # uvicorn exits this way if the application or the port failed
        raise NotStartedError("the service could not start; the log above says why") from refusal


def config_of(settings: Settings, app: FastAPI) -> uvicorn.Config:
    """The configuration of uvicorn.

    uvicorn answers 503 above ``limit_concurrency`` connections or requests. Connections without a
    request count, too. It limits the head of a request by its bytes. `protocol_of` adds the limits
    that uvicorn lacks.

    The client address and the scheme come from X-Forwarded-For and X-Forwarded-Proto only if the
    settings trust the proxy. The environment variable FORWARDED_ALLOW_IPS, which uvicorn would
    read, has no effect.
    """
    return uvicorn.Config(
        app,
        http=protocol_of(settings),
        proxy_headers=settings.proxy_headers,
        forwarded_allow_ips=settings.forwarded_allow_ips,
        limit_concurrency=settings.max_connections,
        h11_max_incomplete_event_size=_MAX_HEAD_BYTES,
        host=settings.host,
        port=settings.port,
        log_config=None,  # configured above
        access_log=False,  # service.web.middleware logs requests with their ids
        server_header=False,
        timeout_graceful_shutdown=_GRACE_S,
        timeout_keep_alive=_KEEP_ALIVE_S,
    )


def _require_fit(settings: Settings) -> None:
    """Call `require_fit` before the server starts, which would hide its error in a traceback."""
    settings.data_dir.mkdir(parents=True, exist_ok=True)
    database = Database(settings.database)
    try:
        require_fit(settings, database)
    finally:
        database.close()
