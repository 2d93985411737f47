"""How the processes of the service log: as text for people, or one JSON object a line.

Whatever a caller sends stays inside its line: JSON escapes it, and in text all control characters are escaped and the
lines of a traceback are indented.
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

_bound: ContextVar[dict[str, Any]] = ContextVar("bound", default={})  # noqa: B039  # never changed, only replaced


@contextmanager
def bound(**fields: Any) -> Iterator[None]:
    """Let every line that is logged in this block, and in threads that serve it, bear ``fields``."""
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
    """A line for people; it begins with the id of the request, or the job, that it belongs to."""

    def __init__(self) -> None:
        super().__init__(_TEXT)

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802  # the library's name
        """The line without its traceback."""
        record.about = getattr(record, "request_id", None) or getattr(record, "job", None) or "-"
        return _escaped(super().formatMessage(record))

    def formatException(self, ei: Any) -> str:  # noqa: N802
        """The traceback, so that none of its lines looks like another entry."""
        return "\n".join(f"    {_escaped(line)}" for line in super().formatException(ei).split("\n"))


def json_formatter() -> logging.Formatter:
    """Time, level, logger, message, what is bound or given as ``extra``, and the exception where there is one."""
    return JsonFormatter(
        ["levelname", "name", "message"],
        rename_fields={"levelname": "level", "name": "logger", "exc_info": "exception"},
        timestamp="time",
        json_ensure_ascii=True,
    )


def set_up(settings: Settings) -> None:
    """Log to standard error, at the level and in the format that the settings name."""
    handler = logging.StreamHandler()
    handler.addFilter(_add_bound)
    handler.setFormatter(json_formatter() if settings.log_format == "json" else TextFormatter())
    logging.basicConfig(level=settings.log_level.upper(), handlers=[handler])
