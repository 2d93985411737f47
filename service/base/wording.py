"""What is wrong with a field, in plain words: one table from pydantic's kinds of errors to sentences with a remedy."""

import json
import re
from collections.abc import Mapping, Sequence
from typing import Any

from pydantic import ValidationError

from service.base.names import FORMS

_OBJECT = "must be a JSON object, {{..}}, not {given}"
_LIST = "must be a list, [..], not {given}"
_NUMBER = "must be a number; send one such as 1.5"
_WHOLE = "must be a whole number; send one such as 3"
_FLAG = "must be true or false"
_TIME = "must be a time such as 2026-06-21T11:36:00Z"
_MORE = "must have {min_length} characters or more"
_FEWER = "must have {max_length} characters or fewer"

SENTENCES: Mapping[str, str] = {
    "missing": "is missing; send it",
    "extra_forbidden": "is not known here; leave it out, or check its spelling",
    "invalid_key": "must have names that are text",
    "none_required": "must be null, or left out",
    "model_type": _OBJECT,
    "model_attributes_type": _OBJECT,
    "dataclass_type": _OBJECT,
    "dict_type": _OBJECT,
    "mapping_type": _OBJECT,
    "list_type": _LIST,
    "tuple_type": _LIST,
    "set_type": _LIST,
    "frozen_set_type": _LIST,
    "iterable_type": _LIST,
    "too_short": "must have {min_length} entries or more, and has {actual_length}",
    "too_long": "must have {max_length} entries or fewer; shorten it",
    "string_type": 'must be text, "..", not {given}',
    "string_unicode": "must be text of valid Unicode",
    "string_too_short": _MORE,
    "string_too_long": _FEWER,
    "bytes_type": 'must be text, "..", not {given}',
    "bytes_too_short": _MORE,
    "bytes_too_long": _FEWER,
    "bool_type": _FLAG + ", not {given}",
    "bool_parsing": _FLAG,
    "int_type": _WHOLE,
    "int_parsing": _WHOLE,
    "int_parsing_size": _WHOLE,
    "int_from_float": _WHOLE,
    "float_type": _NUMBER,
    "float_parsing": _NUMBER,
    "finite_number": "must be a finite number",
    "greater_than": "must be more than {gt}",
    "greater_than_equal": "must be {ge} or more",
    "less_than": "must be less than {lt}",
    "less_than_equal": "must be {le} or less",
    "multiple_of": "must be a multiple of {multiple_of}",
    "literal_error": "must be {expected}",
    "enum": "must be {expected}",
    "datetime_type": _TIME,
    "datetime_parsing": _TIME,
    "datetime_from_date_parsing": _TIME,
    "datetime_object_invalid": _TIME,
    "timezone_aware": "names no time zone; add it, such as Z or +02:00",
    "json_type": "must be JSON as text",
    "recursion_loop": "is nested too deeply; send it flatter",
    "recursion_depth_exceeded": "is nested too deeply; send it flatter",
    "is_instance_of": "must be of the form that /docs shows",
}
"""Of the kinds of errors that fields of ours raise, filled with what the error knows and what was ``given``."""

_OTHERWISE = "must be of the form that /docs shows"
_OUR_OWN = ("value_error", "assertion_error")


def sentence_of(entry: Mapping[str, Any]) -> str:
    """What is wrong with a field and what to do, of an entry of `ValidationError.errors`."""
    kind, context = entry["type"], entry.get("ctx", {})
    if kind in _OUR_OWN:  # a sentence of a validator of ours
        return str(context.get("error", entry["msg"]))
    if kind == "json_invalid":
        return not_json(_place(entry))
    if kind == "string_pattern_mismatch":
        return f"must be {FORMS.get(context['pattern']) or 'text that fits ' + context['pattern']}"
    known = {name: f"{value:.12g}" if isinstance(value, float) else value for name, value in context.items()}
    return SENTENCES.get(kind, _OTHERWISE).format(**known, given=_given(entry.get("input")))


def field_of(location: Sequence[int | str]) -> str:
    """A field's path, such as ``sun.elevation_deg``; empty for the whole.

    Alternatives of a body that may be one of several stand in round brackets, the name of an entry in square ones.
    """
    return ".".join(str(part) for part in location if not str(part).startswith(("(", "[")))


def told(error: ValidationError, whole: str = "document") -> str:
    """The first fault that was found, in one line: the field's path, or ``whole``, and what to do."""
    first = error.errors(include_url=False)[0]
    return f"{field_of(first['loc']) or whole}: {sentence_of(first)}"


def not_json(place: str) -> str:
    """That a text is no JSON from a ``place`` on."""
    return f"is no JSON{place and f', wrong at {place}'}; make it one JSON document"


def place_of(error: json.JSONDecodeError) -> str:
    """Where a text stops being JSON."""
    return f"line {error.lineno}, column {error.colno}"


def _place(entry: Mapping[str, Any]) -> str:
    if entry["loc"] and isinstance(entry["loc"][-1], int):
        return f"character {entry['loc'][-1]}"  # FastAPI puts it where a field's name would stand
    found = re.search(r"line (\d+) column (\d+)", str(entry.get("ctx", {}).get("error", "")))
    return f"line {found[1]}, column {found[2]}" if found else ""


def _given(value: Any) -> str:
    """What a value is, as JSON has it."""
    if isinstance(value, bool):
        return "a truth value"
    kinds = ((str | bytes, "text"), (int | float, "a number"), (list | tuple, "a list"), (Mapping, "an object"))
    return next((name for kind, name in kinds if isinstance(value, kind)), "null" if value is None else "this")
