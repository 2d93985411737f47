"""The FastAPI application, built from the settings."""

import threading
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from importlib.metadata import PackageNotFoundError, version

from anyio import to_thread
from fastapi import APIRouter, Depends, FastAPI
from fastapi.routing import APIRoute
from starlette.routing import BaseRoute

from service.base.discovery import modules_of
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
from service.web.auth.bodies import BodyLimiter
from service.web.auth.dependencies import require_unique_keys
from service.web.auth.fair_limiter import FairLimiter
from service.web.auth.queries import require_known_query
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
        if hasattr(place, "MOUNT"):  # static files; the page in the router takes precedence
            root.mount(*place.MOUNT)
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
