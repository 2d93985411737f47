"""Logging of the service's processes, as text or as one JSON object per line.

Text from callers cannot add lines: JSON escapes it. The text format escapes control characters and
indents tracebacks.
"""

import logging
import re
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

from pythonjsonlogger.json import JsonFormatter

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
