"""Monitoring of the service's processes: logs, OpenTelemetry traces, and metrics for Prometheus.

Logs are text, or one JSON object per line. Text from callers cannot add lines: JSON escapes it. The
text format escapes control characters and indents tracebacks. Traces have requests (FastAPI's
spans), model computations and job attempts.
"""

import logging
import re
import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

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
from pythonjsonlogger.json import JsonFormatter

from service.base.errors import NotStartedError
from service.base.settings import Settings

_TEXT = "%(asctime)s %(levelname)s %(name)s %(about)s %(message)s"
_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029]")

_bound: ContextVar[dict[str, object]] = ContextVar("bound", default={})  # noqa: B039  # never changed, only replaced


@contextmanager
def log_context(**fields: Any) -> Iterator[None]:
    """Add ``fields`` to every log record in this block, and in threads that serve it."""
    token = _bound.set(_bound.get() | fields)
    try:
        yield
    finally:
        _bound.reset(token)


def _add_bound(record: logging.LogRecord) -> bool:
    for name, value in _bound.get().items():
        record.__dict__.setdefault(name, value)
    return True


def _escaped(text: str) -> str:
    return _CONTROL.sub(lambda found: found[0].encode("unicode_escape").decode(), text)


class TextFormatter(logging.Formatter):
    """Text log lines, with the id of the request or job."""

    def __init__(self) -> None:
        super().__init__(_TEXT)

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802  # the library's name
        """Format the line without its traceback."""
        record.about = getattr(record, "request_id", None) or getattr(record, "job", None) or "-"
        return _escaped(super().formatMessage(record))

    def formatException(self, ei: Any) -> str:  # noqa: N802
        """Format the traceback, indented so that no line looks like another entry."""
        return "\n".join(
            f"    {_escaped(line)}" for line in super().formatException(ei).split("\n")
        )


def json_formatter() -> logging.Formatter:
    """JSON log lines: time, level, logger, message, extra fields, and the exception if there is
    one.
    """
    return JsonFormatter(
        ["levelname", "name", "message"],
        rename_fields={"levelname": "level", "name": "logger", "exc_info": "exception"},
        timestamp="time",
        json_ensure_ascii=True,
    )


def configure_logging(settings: Settings) -> None:
    """Log to standard error, at the level and in the format of the settings."""
    handler = logging.StreamHandler()
    handler.addFilter(_add_bound)
    handler.setFormatter(json_formatter() if settings.log_format == "json" else TextFormatter())
    logging.basicConfig(level=settings.log_level.upper(), handlers=[handler])


def configure_tracing(settings: Settings, name: str) -> None:
    """Send this process's spans, as service ``name``, to the collector of the settings, if any.

    Raises
    ------
    NotStartedError
        If a collector is set and the extra packages are not installed.
    """
    if settings.otlp_endpoint is None:
        return
    try:
        from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
        from opentelemetry.sdk.resources import SERVICE_NAME, Resource
        from opentelemetry.sdk.trace import TracerProvider
        from opentelemetry.sdk.trace.export import BatchSpanProcessor
    except ImportError as error:
        raise NotStartedError(
            "otlp_endpoint: install heliotwin[otel] first, or unset it"
        ) from error
    from opentelemetry import trace

    provider = TracerProvider(resource=Resource.create({SERVICE_NAME: name}))
    exporter = OTLPSpanExporter(f"{settings.otlp_endpoint.rstrip('/')}/v1/traces")
    provider.add_span_processor(BatchSpanProcessor(exporter))
    trace.set_tracer_provider(provider)


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
    """Time a block, and record an OpenTelemetry span if `service.base.monitoring` is configured."""
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
