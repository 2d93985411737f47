"""Traces by OpenTelemetry: requests (FastAPI's own spans), uses of the model, and attempts at jobs."""

from service.base.faults import NotStartedError
from service.base.settings import Settings


def set_up(settings: Settings, name: str) -> None:
    """Send this process's spans, as service ``name``, to the collector that the settings name, if they do.

    Raises
    ------
    NotStartedError
        Where they do and the extra packages are not installed.
    """
    if settings.otlp_endpoint is None:
        return
    try:
        from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
        from opentelemetry.sdk.resources import SERVICE_NAME, Resource
        from opentelemetry.sdk.trace import TracerProvider
        from opentelemetry.sdk.trace.export import BatchSpanProcessor
    except ImportError as error:
        raise NotStartedError("otlp_endpoint: install heliotwin[otel] first, or unset it") from error
    from opentelemetry import trace

    provider = TracerProvider(resource=Resource.create({SERVICE_NAME: name}))
    exporter = OTLPSpanExporter(f"{settings.otlp_endpoint.rstrip('/')}/v1/traces")
    provider.add_span_processor(BatchSpanProcessor(exporter))
    trace.set_tracer_provider(provider)
