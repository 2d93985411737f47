"""Validation of names and text: patterns, checks, and messages for what is invalid.

Patterns are of names for paths and URLs, and of text for databases and logs. Messages are
pydantic's own, but for those that mislead.
"""

import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from pydantic import ValidationError

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


_OBJECT = "must be a JSON object, {..}"
_LIST = "must be a list, [..]"
NO_TIME = "must be a time such as 2026-06-21T11:36:00Z"
"""The message that a value is no time."""
_DEEP = "is nested too deeply; send it flatter"
_OTHERWISE = "must be of the form that /docs shows"

ERROR_MESSAGES: Mapping[str, str] = {
    "missing": "is missing; send it",
    "extra_forbidden": "is not known here; leave it out, or check its spelling",
    "invalid_key": "must have names that are text",
    "none_required": "must be null, or left out",
    "timezone_aware": "names no time zone; add it, such as Z or +02:00",
    "int_parsing_size": "must be a smaller whole number",
    "int_parsing": "must be a whole number",
    "int_from_float": "must be a whole number",
    "float_parsing": "must be a number",
    "bool_parsing": "must be true or false",
    "string_type": 'must be text, ".."',
    "string_unicode": "must be text of valid Unicode",
    "bytes_type": 'must be text, ".."',
    "json_type": "must be JSON as text",
    "bool_type": "must be true or false",
    "recursion_loop": _DEEP,
    "recursion_depth_exceeded": _DEEP,
    "is_instance_of": _OTHERWISE,
    **dict.fromkeys(("dict_type", "mapping_type", "dataclass_type"), _OBJECT),
    **dict.fromkeys(("model_type", "model_attributes_type"), _OBJECT),
    **dict.fromkeys(("list_type", "tuple_type", "set_type"), _LIST),
    **dict.fromkeys(("frozen_set_type", "iterable_type"), _LIST),
    **dict.fromkeys(("datetime_type", "datetime_parsing"), NO_TIME),
    **dict.fromkeys(("datetime_from_date_parsing", "datetime_object_invalid"), NO_TIME),
}
"""Messages by pydantic's error type, if its own message names a Python type or no remedy."""

# How pydantic's own messages begin: the field's path takes the place of this subject.
_SUBJECT = re.compile("^[A-Z][a-z]+ should ")


def not_a_number(value: object) -> str:
    """The message that a JSON value is no number."""
    kind = {str: "the string ", bool: ""}.get(type(value))
    return "must be a number" + ("" if kind is None else f", not {kind}{json.dumps(value)[:40]}")


def message_of(entry: Mapping[str, Any]) -> str:
    """The message of an entry of `ValidationError.errors`."""
    kind, context = entry["type"], entry.get("ctx", {})
    if kind in ("value_error", "assertion_error"):  # the message of one of our validators
        return str(context.get("error", entry["msg"]))
    if kind == "json_invalid":
        return not_json(_place(entry))
    if kind == "string_pattern_mismatch":
        return f"must be {FORMS.get(context['pattern']) or 'text that fits ' + context['pattern']}"
    if kind in ("float_type", "int_type"):
        return not_a_number(entry["input"])
    own = _SUBJECT.sub("must ", entry["msg"])
    own = re.sub("less than or equal to (.+)", r"\1 or less", own)
    own = re.sub("greater than or equal to (.+)", r"\1 or more", own)
    return ERROR_MESSAGES.get(kind, own if own.startswith("must ") else _OTHERWISE)


def field_of(location: Sequence[int | str]) -> str:
    """A field's path, such as ``sun.elevation_deg``; empty for the whole document.

    Round brackets mark the variant of a union and square ones an entry's name; both are left out.
    """
    return ".".join(str(part) for part in location if not str(part).startswith(("(", "[")))


def format_validation_error(error: ValidationError, whole: str = "document") -> str:
    """The first error in one line: the field's path, or ``whole``, and what to do."""
    first = error.errors(include_url=False)[0]
    return f"{field_of(first['loc']) or whole}: {message_of(first)}"


def not_json(place: str) -> str:
    """The message that a text is not JSON at ``place``."""
    return f"is no JSON{place and f', wrong at {place}'}; make it one JSON document"


def place_of(error: json.JSONDecodeError) -> str:
    """The position at which a text stops being JSON."""
    return f"line {error.lineno}, column {error.colno}"


def _place(entry: Mapping[str, Any]) -> str:
    if entry["loc"] and isinstance(entry["loc"][-1], int):
        # FastAPI puts the position in place of a field's name.
        return f"character {entry['loc'][-1]}"
    found = re.search(r"line (\d+) column (\d+)", str(entry.get("ctx", {}).get("error", "")))
    return f"line {found[1]}, column {found[2]}" if found else ""
