"""Patterns of names for paths and URLs, and of text for databases and logs."""

import math
import re
from collections.abc import Iterator
from typing import Any

from model.errors import InvalidInputError

NAME = r"^[A-Za-z0-9][A-Za-z0-9_-]{0,31}$"
"""Names of heliostats, targets and the plant."""

IDENTIFIER = r"^[A-Za-z0-9][A-Za-z0-9_-]{0,63}$"
"""Identifiers of measurements from their sender."""

MEASUREMENT = r"^[A-Za-z0-9][A-Za-z0-9_-]{0,95}$"
"""Identifiers of measurements from the service."""

LINE = r"^[^\x00-\x1f\x7f-\x9f]*$"
"""One line of free text. Pydantic itself rejects lone surrogates."""

LINES = r"^[^\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f]*$"
"""Free text with optional line breaks and tabs."""

KEY = r"^[\x21-\x7e]{1,128}$"
FORMS = {
    pattern: f"1 to {most} letters, digits, underscores and hyphens, the first a letter or digit"
    for pattern, most in ((NAME, 32), (IDENTIFIER, 64), (MEASUREMENT, 96))
} | {
    LINE: "one line of text without control characters",
    LINES: "text without control characters other than line breaks and tabs",
    KEY: "1 to 128 letters, digits and signs of ASCII without blanks",
}
"""Descriptions of the patterns."""

_NO_TEXT = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\ud800-\udfff]")


def require_name(pattern: str, value: str, what: str) -> None:
    """Raise `InvalidInputError` unless ``value`` fits ``pattern``; ``what`` describes the name."""
    if re.fullmatch(pattern, value) is None:
        raise InvalidInputError(f"{what} {value[:40]!r}: must be {FORMS[pattern]}")


def counted(count: int, noun: str) -> str:
    """A number with its noun: 1 heliostat, 2,650 heliostats."""
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def is_text(value: str) -> bool:
    """Whether a string has no lone surrogates or control characters (except line breaks, tabs)."""
    return _NO_TEXT.search(value) is None


def escape_control_characters(text: str) -> str:
    """Escape the characters that `is_text` rejects, because file names may contain any."""
    return _NO_TEXT.sub(lambda found: ascii(found[0])[1:-1], text)


def require_text(document: Any, where: str) -> None:
    """Check that a JSON document's strings are text and its numbers finite.

    Raises
    ------
    InvalidInputError
        If `is_text` does not hold for a key or a string, or a number is not finite, which JSON
        demands and Python's reader does not. It names the place.
    """
    # One iterator for each level, so that a wide document needs no more memory.
    pending = [iter(((where, document),))]
    while pending:
        for place, value in pending[-1]:
            _require_plain(value, place)
            if isinstance(value, dict):
                for key in value:
                    _require_plain(key, place)
            if isinstance(value, dict | list):
                pending.append(_entries(place, value))
                break
        else:
            pending.pop()


def _entries(place: str, value: dict[str, object] | list[Any]) -> Iterator[tuple[str, Any]]:
    """Yield what a document holds one level below a place, each with its own place."""
    if isinstance(value, dict):
        yield from ((f"{place}.{key}", entry) for key, entry in value.items())
    else:
        yield from ((f"{place}[{index}]", entry) for index, entry in enumerate(value))


def _require_plain(value: Any, place: str) -> None:
    if isinstance(value, str) and not is_text(value):
        raise InvalidInputError(
            f"{ascii(place)[1:-1]}: must be {FORMS[LINES]}, and of whole characters"
        )
    if isinstance(value, float) and not math.isfinite(value):
        raise InvalidInputError(f"{ascii(place)[1:-1]}: must be a finite number")
