"""Whether the process lives, and whether it can work."""

import logging
from collections.abc import Callable
from typing import Literal

from anyio import CapacityLimiter, to_thread
from fastapi import APIRouter, Response, status
from pydantic import BaseModel

from model.network.predictor import default_predictor
from service.base.faults import StoreDamagedError
from service.twin.runtime import Runtime
from service.web.door.dependencies import RuntimeDep


class Health(BaseModel):
    """The state of the service; each check is "ok" or says what is wrong."""

    status: Literal["ok", "unavailable"]
    checks: dict[str, str]


router = APIRouter(tags=["health"])
logger = logging.getLogger("heliotwin.service")

# Its own thread, so that a busy service still says that it is ready.
_checker = CapacityLimiter(1)


def _check(name: str, question: Callable[[], str]) -> str:
    try:
        return question()
    except StoreDamagedError as error:
        logger.error("readiness check failed: %s: %s", name, error)
        return "damaged: run `heliotwin check`, and restore a back-up"
    except Exception:  # whatever it is, not being ready is the answer; the log has the rest
        logger.exception("readiness check failed: %s", name)
        return "unavailable"


def _database(runtime: Runtime) -> str:
    runtime.database.ping()
    return "ok"


def _migrations(runtime: Runtime) -> str:
    return "ok" if runtime.database.is_current() else "not at the newest version: run `heliotwin migrate`"


def _weights(_runtime: Runtime) -> str:
    default_predictor()
    return "ok"


def _ask_all(runtime: Runtime) -> dict[str, str]:
    questions = {"database": _database, "migrations": _migrations, "weights": _weights}
    return {name: _check(name, lambda ask=ask: ask(runtime)) for name, ask in questions.items()}  # type: ignore[misc]


@router.get("/livez")
async def get_livez() -> Health:
    """The process answers."""
    return Health(status="ok", checks={})


@router.get("/readyz", responses={503: {"model": Health, "description": "Something that it needs is missing."}})
async def get_readyz(runtime: RuntimeDep, response: Response) -> Health:
    """The database answers at the newest schema and the network's weights can be loaded."""
    checks = await to_thread.run_sync(_ask_all, runtime, limiter=_checker)
    is_ready = all(answer == "ok" for answer in checks.values())
    if not is_ready:
        response.status_code = status.HTTP_503_SERVICE_UNAVAILABLE
    return Health(status="ok" if is_ready else "unavailable", checks=checks)
