"""Times as text."""

from datetime import UTC, datetime


def format_time(moment: datetime) -> str:
    """RFC 3339 text of a time in UTC, with ``Z``; seconds have a fraction only if it is not 0."""
    return moment.astimezone(UTC).isoformat().replace("+00:00", "Z")
