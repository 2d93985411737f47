"""The application: settings in, FastAPI out."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from importlib.metadata import PackageNotFoundError, version

from anyio import to_thread
from fastapi import APIRouter, FastAPI
from fastapi.routing import APIRoute

from service import errors, openapi
from service.middleware import BodyLimitMiddleware, RequestIdMiddleware
from service.routers import forecasts, health, heliostats, measurements, plant, surfaces
from service.runtime import Operations, Runtime
from service.settings import Settings

_DESCRIPTION = (
    "Post the target photographs of a solar tower, read back each heliostat's flux and surface, and forecast the "
    "flux that it throws on any plane. Metres, degrees where a name says so, east-north-up from the tower base."
)


def _version() -> str:
    try:
        return version("heliotwin")
    except PackageNotFoundError:  # run from a checkout that is not installed
        return "0"


def _operation_id(route: APIRoute) -> str:
    return route.name


def create_app(settings: Settings, operations: Operations | None = None) -> FastAPI:
    """The service for these settings.

    ``operations`` stands in for the model (`service.operations`) in tests. The store is opened, and an embedded SQLite
    one migrated, when the application starts; a store that nobody migrated keeps it from starting.
    """

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        runtime = await to_thread.run_sync(Runtime.from_settings, settings, operations)
        try:
            if settings.migrates_on_start:
                await to_thread.run_sync(runtime.database.upgrade)
            await to_thread.run_sync(runtime.database.require_current)
            app.state.runtime = runtime
            yield
        finally:
            runtime.close()

    app = FastAPI(
        title="heliotwin",
        version=_version(),
        description=_DESCRIPTION,
        lifespan=lifespan,
        generate_unique_id_function=_operation_id,
        redirect_slashes=False,
    )
    v1 = APIRouter(prefix="/v1")
    for module in (plant, heliostats, measurements, surfaces, forecasts):
        v1.include_router(module.router)
    app.include_router(v1)
    app.include_router(health.router)
    errors.install(app)
    openapi.install(app)
    app.add_middleware(BodyLimitMiddleware, settings=settings)
    app.add_middleware(RequestIdMiddleware)
    return app
