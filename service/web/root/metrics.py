"""Metrics for Prometheus."""

from fastapi import APIRouter, Response
from prometheus_client import CONTENT_TYPE_LATEST, generate_latest

from service.web.auth.dependencies import OVERVIEW_SLOT, READ, FieldCacheDep, RuntimeDep
from service.web.responses.openapi import TEXT
from service.web.store_metrics import registry

router = APIRouter(tags=["health"])


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
