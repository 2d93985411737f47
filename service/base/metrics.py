"""Counters and timers of this process for Prometheus.

Labels never take values from senders: routes are templates, and kinds, operations and reasons are
constants in the code.
"""

import time
from collections.abc import Iterator
from contextlib import contextmanager

from opentelemetry import trace
from prometheus_client import (
    CollectorRegistry,
    Counter,
    GCCollector,
    Histogram,
    PlatformCollector,
    ProcessCollector,
    start_http_server,
)

from service.base.settings import Settings

PROCESS = CollectorRegistry()
"""All metrics of this process."""


for _collector in (GCCollector, PlatformCollector, ProcessCollector):
    _collector(registry=PROCESS)


_TIMES_S = (0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0)

REQUESTS = Counter(
    "heliotwin_http_requests",
    "Requests by the template of their path.",
    ["method", "route", "status"],
    registry=PROCESS,
)

REQUEST_SECONDS = Histogram(
    "heliotwin_http_request_seconds",
    "Time until an answer begins [s].",
    ["method", "route"],
    buckets=_TIMES_S,
    registry=PROCESS,
)

PHOTOGRAPHS = Counter(
    "heliotwin_photographs",
    "Photographs that came: accepted, refused, or known before.",
    ["outcome"],
    registry=PROCESS,
)

REFUSALS = Counter(
    "heliotwin_photographs_refused",
    "Photographs kept but refused, by the reason.",
    ["reason"],
    registry=PROCESS,
)

ACCURACY = Histogram(
    "heliotwin_forecast_accuracy",
    "Flux accuracy of the current twin on each new photograph, before it learns from it [1].",
    buckets=(0.3, 0.5, 0.6, 0.7, 0.75, 0.8, 0.85, 0.9, 0.95, 1.0),
    registry=PROCESS,
)

MODEL_SECONDS = Histogram(
    "heliotwin_model_seconds",
    "Time of one use of the model: measuring, inference, tracing, studies [s].",
    ["operation"],
    buckets=_TIMES_S,
    registry=PROCESS,
)

WAITING_SECONDS = Histogram(
    "heliotwin_model_waiting_seconds",
    "Time that such a use waited for others to end [s].",
    buckets=_TIMES_S,
    registry=PROCESS,
)

JOB_ATTEMPTS = Counter(
    "heliotwin_job_attempts",
    "Attempts at jobs by how they ended: done, failed, retried, cancelled, released, lost, stuck.",
    ["kind", "outcome"],
    registry=PROCESS,
)

JOB_SECONDS = Histogram(
    "heliotwin_job_seconds",
    "Time of an attempt at a job [s].",
    ["kind"],
    buckets=_TIMES_S,
    registry=PROCESS,
)

_tracer = trace.get_tracer("heliotwin")


@contextmanager
def measure_duration(histogram: Histogram, span: str) -> Iterator[None]:
    """Time a block, and record an OpenTelemetry span if `service.base.telemetry` is configured."""
    started = time.perf_counter()
    with _tracer.start_as_current_span(span):
        try:
            yield
        finally:
            histogram.observe(time.perf_counter() - started)


@contextmanager
def serve_metrics(settings: Settings, meters: CollectorRegistry) -> Iterator[None]:
    """Serve ``meters`` on the metrics port, if the settings name one."""
    if settings.metrics_port is None:
        yield
        return
    server, thread = start_http_server(settings.metrics_port, settings.metrics_host, meters)
    try:
        yield
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
