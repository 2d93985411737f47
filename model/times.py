"""Times as text."""

from datetime import UTC, datetime


def format_time(moment: datetime) -> str:
    """RFC 3339 text of a time in UTC, with ``Z``; seconds have a fraction only if it is not 0."""
    return moment.astimezone(UTC).isoformat().replace("+00:00", "Z")


def format_minute(moment: datetime) -> str:
    """Text of a time for messages, as ``2026-06-21 11:00 UTC``; pages show the plant's time."""
    return f"{moment.astimezone(UTC):%Y-%m-%d %H:%M} UTC"
