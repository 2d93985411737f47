"""The application: settings in, FastAPI out."""

import threading
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from importlib.metadata import PackageNotFoundError, version

from anyio import to_thread
from fastapi import APIRouter, FastAPI
from fastapi.routing import APIRoute

from service.base.discovery import modules_of
from service.base.meters import listening
from service.base.settings import Settings
from service.jobs.kind import Kinds
from service.jobs.kinds import KINDS
from service.jobs.worker import Workers
from service.store.database import Database
from service.twin.accuracy import ComparisonBook
from service.twin.attention import AttentionCount
from service.twin.field import FieldBook
from service.twin.gate import MOST_WAITING
from service.twin.runtime import Operations, Runtime
from service.web.answers import openapi, problems
from service.web.answers.watching import Watchers
from service.web.api import jobs
from service.web.door import security
from service.web.door.turns import Turns
from service.web.metrics import registry
from service.web.middleware import (
    BodyLimitMiddleware,
    DoorMiddleware,
    HeadMiddleware,
    PartMiddleware,
    RequestIdMiddleware,
    SecurityHeadersMiddleware,
    StoppingMiddleware,
)

_DESCRIPTION = (
    "Post the target photographs of a solar tower, read back each heliostat's flux and surface, and forecast the "
    "flux that it throws on any plane. Metres, degrees where a name says so, east-north-up from the tower base. HEAD "
    "is answered wherever GET is."
)


def _version() -> str:
    try:
        return version("heliotwin")
    except PackageNotFoundError:  # run from a checkout that is not installed
        return "0"


def _operation_id(route: APIRoute) -> str:
    return route.name


def require_fit(settings: Settings, database: Database) -> None:
    """Migrate an embedded store; refuse one that nobody migrated, and a door that would stand open to others.

    Raises
    ------
    SchemaError, OpenDoorError
    """
    if settings.migrates_on_start:
        database.upgrade()
    database.require_current()
    security.require_closed_door(settings, database)


def create_app(settings: Settings, operations: Operations | None = None, kinds: Kinds = KINDS) -> FastAPI:
    """The service for these settings.

    ``operations`` stands in for the model (`service.twin.compute`) in tests. The store is opened, and an embedded
    SQLite one migrated, when the application starts; a store that nobody migrated keeps it from starting, and so does
    a door that would stand open to other machines. Jobs of ``kinds`` can be asked for, and are worked at where the
    settings say so.
    """

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        runtime = await to_thread.run_sync(Runtime.from_settings, settings, operations)
        try:
            await to_thread.run_sync(require_fit, settings, runtime.database)
            app.state.runtime = runtime.for_requests()
            app.state.field = FieldBook(runtime)
            app.state.attention = AttentionCount(runtime, app.state.field)
            app.state.watchers = Watchers(runtime)
            app.state.comparisons = ComparisonBook(runtime)
            workers = Workers(runtime, kinds, settings.job_workers)
            workers.start()
            try:
                with listening(settings, registry(runtime, app.state.field)):
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
        generate_unique_id_function=_operation_id,
        redirect_slashes=False,
        docs_url=None,  # service.web.root.documentation has its own page
        redoc_url=None,
    )
    app.state.stopping = threading.Event()
    app.state.turns = Turns()
    app.state.kinds = kinds
    app.state.computing = Turns(settings.parallel_computations + MOST_WAITING)  # as many as the model's gate takes
    v1 = APIRouter(prefix="/v1")
    v1.include_router(jobs.creators(kinds))  # before the routes of a job, which would take their names for numbers
    for resource in modules_of("service.web.api"):
        v1.include_router(resource.router)
    app.include_router(v1)
    for place in (*modules_of("service.web.root"), *modules_of("service.web.pages")):
        if hasattr(place, "router"):
            app.include_router(place.router)
        if hasattr(place, "MOUNT"):  # files, at a path; its page, in the router, comes first
            app.mount(*place.MOUNT)
    security.require_declared_roles(app)
    problems.install(app)
    openapi.install(app)
    app.add_middleware(PartMiddleware)
    app.add_middleware(StoppingMiddleware)
    app.add_middleware(BodyLimitMiddleware, settings=settings)
    app.add_middleware(DoorMiddleware, settings=settings)
    app.add_middleware(HeadMiddleware)
    app.add_middleware(SecurityHeadersMiddleware)
    app.add_middleware(RequestIdMiddleware)  # added last, it comes first
    return app
