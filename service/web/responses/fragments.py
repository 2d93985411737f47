"""A part of a page as a file.

``?table=NAME`` is a table of the page as CSV, and ``?figure=NAME&format=..`` is a figure.
"""

from dataclasses import dataclass
from urllib.parse import parse_qsl, urlencode

from starlette.types import Scope

_NAMES = ("table", "figure", "format")


@dataclass(frozen=True)
class Part:
    """The requested part of a page: a ``table``, or a ``figure`` in a ``format``."""

    table: str | None = None
    figure: str | None = None
    format: str = ""


def take_part(scope: Scope) -> None:
    """Move the requested part of a page from the query to the request state.

    Routes accept only their own query parameters.
    """
    if scope["path"].startswith("/v1/") or scope["method"] != "GET":
        return
    query = parse_qsl(scope["query_string"].decode("ascii", "replace"), keep_blank_values=True)
    asked = {name: value for name, value in query if name in _NAMES}
    if "table" in asked or "figure" in asked:
        scope["query_string"] = urlencode(
            [(name, value) for name, value in query if name not in _NAMES]
        ).encode()
        scope.setdefault("state", {})["part"] = Part(**asked)
