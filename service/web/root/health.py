"""Probes and metrics: whether the process lives and can work, and its figures for Prometheus."""

import logging
from collections.abc import Callable
from typing import Literal

from anyio import CapacityLimiter, Lock, to_thread
from fastapi import APIRouter, Request, Response, status
from prometheus_client import CONTENT_TYPE_LATEST, generate_latest
from pydantic import BaseModel, Field

from model.errors import WeightsError
from model.network.predictor import default_predictor
from model.prior import default_prior
from service.base.errors import StoreDamagedError
from service.twin.runtime import Runtime
from service.web.auth.dependencies import OVERVIEW_SLOT, READ, FieldCacheDep, RuntimeDep
from service.web.responses.openapi import TEXT
from service.web.store_metrics import registry


class Health(BaseModel):
    """The state of the service. Each check is "ok" or a description of the failure."""

    status: Literal["ok", "unavailable"] = Field(description="Whether all checks passed.")
    checks: dict[str, str] = Field(description="By name: ok, or what is wrong.")


router = APIRouter(tags=["health"])
logger = logging.getLogger("heliotwin.service")

# A separate thread, so that the probe also answers while the service is busy.
_checker = CapacityLimiter(1)


class SharedCheck:
    """Check that runs once at a time and shares its result with waiting requests.

    Many requests cost no more than one check after the other. A result is never older than its
    request.
    """

    def __init__(self) -> None:
        self._lock = Lock()
        self._begun = self._done = 0
        self._result: dict[str, str] = {}

    async def result(self, check: Callable[[], dict[str, str]]) -> dict[str, str]:
        """Return the result of a check that began after this call."""
        wanted = self._begun + 1
        async with self._lock:
            if self._done < wanted:
                self._begun = number = self._begun + 1
                self._result = await to_thread.run_sync(check, limiter=_checker)
                self._done = number
            return self._result


def _check(name: str, question: Callable[[], str]) -> str:
    try:
        return question()
    except StoreDamagedError as error:
        logger.error("readiness check failed: %s: %s", name, error)
        return "damaged: run `heliotwin check`, and restore a back-up"
    except WeightsError as error:
        logger.error("readiness check failed: %s", error)
        return str(error)
    except Exception:  # any failure means not ready; the log has the details
        logger.exception("readiness check failed: %s", name)
        return "unavailable"


def _database(runtime: Runtime) -> str:
    runtime.database.ping()
    return "ok"


def _migrations(runtime: Runtime) -> str:
    return (
        "ok"
        if runtime.database.is_current()
        else "not at the newest version: run `heliotwin migrate`"
    )


def _weights(_runtime: Runtime) -> str:
    default_predictor()
    default_prior()
    return "ok"


def _ask_all(runtime: Runtime) -> dict[str, str]:
    questions = {"database": _database, "migrations": _migrations, "weights": _weights}
    return {name: _check(name, lambda run=run: run(runtime)) for name, run in questions.items()}  # type: ignore[misc]


@router.get("/livez")
async def get_livez() -> Health:
    """Check that the process answers."""
    return Health(status="ok", checks={})


@router.get(
    "/readyz",
    responses={503: {"model": Health, "description": "Something that it needs is missing."}},
)
async def get_readyz(request: Request, runtime: RuntimeDep, response: Response) -> Health:
    """Check that the service is ready.

    The database answers with the newest schema. The network and the prior match their model cards.
    """
    readiness: SharedCheck = request.app.state.readiness
    checks = await readiness.result(lambda: _ask_all(runtime))
    is_ready = all(answer == "ok" for answer in checks.values())
    if not is_ready:
        response.status_code = status.HTTP_503_SERVICE_UNAVAILABLE
    return Health(status="ok" if is_ready else "unavailable", checks=checks)


@router.get(
    "/metrics",
    response_class=Response,
    responses={
        200: {
            "description": "Prometheus' text format.",
            "content": {"text/plain": {"schema": TEXT}},
        }
    },
    dependencies=[READ, OVERVIEW_SLOT],
)
def get_metrics(runtime: RuntimeDep, cache: FieldCacheDep) -> Response:
    """Get metrics for Prometheus. They are of this process, the job queue, and drifts."""
    return Response(generate_latest(registry(runtime, cache)), media_type=CONTENT_TYPE_LATEST)
