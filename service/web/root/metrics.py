"""The figures that Prometheus reads."""

from fastapi import APIRouter, Response
from prometheus_client import CONTENT_TYPE_LATEST, generate_latest

from service.web.answers.openapi import TEXT
from service.web.door.dependencies import READ, FieldBookDep, RuntimeDep
from service.web.metrics import registry

router = APIRouter(tags=["health"])


@router.get(
    "/metrics",
    response_class=Response,
    responses={200: {"description": "Prometheus' text format.", "content": {"text/plain": {"schema": TEXT}}}},
    dependencies=[READ],
)
def get_metrics(runtime: RuntimeDep, book: FieldBookDep) -> Response:
    """Counts and times of this process, the queue, and the drift of heliostats."""
    return Response(generate_latest(registry(runtime, book)), media_type=CONTENT_TYPE_LATEST)
