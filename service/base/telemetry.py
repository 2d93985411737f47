"""OpenTelemetry traces of requests (FastAPI's spans), model computations and job attempts."""

from service.base.errors import NotStartedError
from service.base.settings import Settings


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
