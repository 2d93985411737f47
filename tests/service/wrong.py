"""Invalid documents, and how to detect messages of libraries."""

import re
from collections.abc import Callable, Iterator
from typing import Any

from pydantic_core import _pydantic_core

# Instead of what a field takes.
WRONG: list[Any] = [
    None,
    True,
    1.5,
    -1e12,
    1e12,
    float("nan"),
    "",
    "no such thing",
    "2024-06-01T09:00:00",
    "x" * 300,
]
WRONG += [[], [1] * 70, {}]

# Every kind of error that pydantic knows.
LISTED = _pydantic_core.list_all_errors()


def _raw() -> re.Pattern[str]:
    """What pydantic, FastAPI and the JSON reader say by themselves."""
    templates = {
        entry[key] for entry in LISTED for key in entry if key.startswith("message_template")
    }
    parts = [re.split(r"\{[^}]*\}", template) for template in templates]
    said = [
        ".{0,300}".join(map(re.escape, part))
        for part in parts
        if len("".join(part)) > len("Invalid JSON: ")
    ]
    others = (
        "JSON decode error",
        "Expecting ",
        "Expected UploadFile",
        "Value error",
        "Assertion failed",
        "Invalid JSON",
    )
    return re.compile("|".join([*said, *others]))


RAW = _raw()


def deep(document: Any) -> int:
    """How many levels there are below this one."""
    inner = (
        document.values()
        if isinstance(document, dict)
        else document
        if isinstance(document, list)
        else []
    )
    return max((1 + deep(part) for part in inner), default=0)


def at_level(document: Any, level: int, change: Callable[[Any], Any]) -> Any:
    """The document with everything of one level changed."""
    if level == 0:
        return change(document)
    if isinstance(document, dict):
        return {name: at_level(part, level - 1, change) for name, part in document.items()}
    return (
        [at_level(part, level - 1, change) for part in document]
        if isinstance(document, list)
        else document
    )


def wrong_everywhere(document: Any) -> Iterator[Any]:
    """The document with something wrong in all places of a level at once, one way after
    the other.
    """
    for level in range(deep(document) + 1):
        for value in WRONG:
            yield at_level(document, level, lambda _, value=value: value)  # type: ignore[misc]
        yield at_level(
            document, level, lambda part: {**part, "unknown": 1} if isinstance(part, dict) else part
        )
        yield at_level(document, level, lambda part: {} if isinstance(part, dict) else part)


def wrong_somewhere(document: Any) -> Iterator[Any]:
    """The document with something wrong in one place, one way after the other: what stops at the
    first fault.
    """
    yield from WRONG
    inner = (
        document.items()
        if isinstance(document, dict)
        else enumerate(document)
        if isinstance(document, list)
        else []
    )
    for key, part in inner:
        if isinstance(document, dict):
            yield {name: value for name, value in document.items() if name != key}
        for changed in wrong_somewhere(part):
            whole = document.copy()
            whole[key] = changed
            yield whole
