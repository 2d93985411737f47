"""Rendering of templates, and responses for browsers instead of JSON.

A part of a page is a file: ``?table=NAME`` is a table of the page as CSV, and
``?figure=NAME&format=..`` is a figure.
"""

import hashlib
import json
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from datetime import datetime
from functools import cache
from http import HTTPStatus
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl, quote, urlencode

from fastapi import Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import HTMLResponse, RedirectResponse
from jinja2 import Environment
from markupsafe import Markup
from pydantic import ValidationError
from starlette.datastructures import Headers
from starlette.types import Scope

from service.base.arrays import pack
from service.base.errors import NotFoundError
from service.base.validation import counted
from service.drawing.charts import Figure
from service.drawing.templates import ASSETS, environment, form_time, moment, times_in_zone
from service.jobs.enqueuing import enqueue
from service.jobs.kind import Kind, Payload
from service.twin.forecasts.aims import plant_time_zone
from service.twin.runtime import Runtime
from service.web.auth.security import LOCAL, Identity, Role
from service.web.responses.lists import CSV, Column, PageTable, sheet

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


# Settings of htmx: no code from text and no inline styles, which the content security policy
# forbids. Error responses are shown, too.
_HTMX = {
    "allowEval": False,
    "includeIndicatorStyles": False,
    "selfRequestsOnly": True,
    "historyCacheSize": 0,
    "responseHandling": [
        {"code": "204", "swap": False},
        {"code": "[23]..", "swap": True},
        {"code": "[45]..", "swap": True, "error": True},
    ],
}

# htmx puts an error into the notice of `base.html`, whatever part of the page it requested.
_NOTICE = {
    "HX-Retarget": "#notice",
    "HX-Reswap": "innerHTML",
    "HX-Reselect": ".alert",
    "HX-Push-Url": "false",
}


GUIDE = Path(__file__).resolve().parents[1] / "root" / "guide"
"""The built guide; an installation puts it here."""


def has_guide() -> bool:
    """Whether this installation has the guide."""
    return (GUIDE / "index.html").is_file()


@cache
def asset(name: str) -> str:
    """The path of a style or script. It holds a digest of the content, so browsers may cache it."""
    digest = hashlib.sha256(ASSETS.joinpath(name).read_bytes()).hexdigest()[:12]
    return f"/static/{name}?v={digest}"


@dataclass
class _Rendering:
    """State of a page while it is rendered.

    Its path, the plant's time zone, its figures and tables by name, and at the end its text.
    """

    page: str
    zone: str = "UTC"
    figures: dict[str, Figure] = field(default_factory=dict)
    tables: dict[str, PageTable] = field(default_factory=dict)
    text: str = ""

    def link(self, **part: str) -> str:
        """The URL of a part of the page."""
        return f"{self.page}{'&' if '?' in self.page else '?'}{urlencode(part)}"


# Macros link to parts of the page, but do not know the page that calls them.
_RENDERING: ContextVar[_Rendering] = ContextVar("rendering")


def _new_table(name: str, has_choice: bool = False) -> PageTable:
    """Begin a table of the page. The URL ``link_to_table`` is its CSV.

    With ``has_choice`` the page shows the columns that its query names, all by default.
    """
    chosen = [value for key, value in _query() if has_choice and key == "columns"]
    made = _RENDERING.get().tables[name] = PageTable(shown=frozenset(chosen))
    return made


def _query() -> list[tuple[str, str]]:
    """Names and values of the page's query."""
    return parse_qsl(_RENDERING.get().page.partition("?")[2])


def _add_cell(*cell: Any) -> Column:
    """Add a cell to the newest table of the page."""
    return next(reversed(_RENDERING.get().tables.values())).add(*cell)


def _zone() -> str:
    return _RENDERING.get().zone


def _moment(value: datetime | None) -> str | Markup:
    """A time in the plant's time zone."""
    return moment(value, _zone())


# Paths of pages in the words of alarms and warnings, which REST answers as they are.
_PATH = re.compile(r"(?<![\w/])(/(?:photographs|jobs|studies)\b(?:[^\s,;()]*\w)?)")


def _linked(text: str) -> Markup:
    """Text with links instead of the paths of pages, and with code for words in backticks."""
    parts = _PATH.split(text)
    linked = Markup("").join(_link(part) if at % 2 else part for at, part in enumerate(parts))
    return Markup(re.sub("`([^`]+)`", r"<code>\1</code>", str(linked)))


def _link(path: str) -> Markup:
    link = Markup('<a href="{}">{}</a>').format
    if path.startswith("/photographs?"):
        review = path.replace("?", "/review?", 1)
        return link(path, "its photographs") + " (" + link(review, "review them") + ")"
    return link(path, path.replace("/jobs/", "job ").replace("/studies/", "study "))


def _shown(value: Any) -> str:
    """The value of a table's cell as text of the page."""
    match value:
        case list():
            return Markup("").join(map(_shown, value))
        case datetime() | None:
            return _moment(value)
    return str(value)


def _link_to_table(name: str) -> str:
    return _RENDERING.get().link(table=name)


def _link_to_figure(name: str, figure: Figure) -> str:
    """Register a figure of the page, and return its URL without the ``format``.

    The URL is valid while the page shows the figure.
    """
    _RENDERING.get().figures[name] = figure
    return _RENDERING.get().link(figure=name)


def _environment() -> Environment:
    made = environment("service.web.pages", "service.drawing")
    made.globals.update(asset=asset, htmx_settings=json.dumps(_HTMX))
    made.globals.update(link_to_table=_link_to_table, link_to_figure=_link_to_figure)
    made.globals.update(new_table=_new_table, add_cell=_add_cell, has_guide=has_guide)
    made.globals.update(query=_query)
    made.globals.update(plant_zone=_zone)
    made.filters.update(
        shown=_shown,
        counted=counted,
        linked=_linked,
        plant_times=lambda text: times_in_zone(str(text), _zone()),
        moment=_moment,
        form_time=lambda value: form_time(value, _zone()),
    )
    return made


TEMPLATES = _environment()
"""The templates of the pages."""


def count_badge(number: int) -> Markup:
    """The number of alarms that are not acknowledged, for the menu; empty for none."""
    badge = '<span class="count">{}<span class="hidden"> not acknowledged</span></span>'
    return Markup(badge).format(number) if number else Markup("")


def _rendered(
    scope: Scope, template: str, context: dict[str, object], zone: str = "UTC"
) -> _Rendering:
    identity: Identity | None = scope.get("state", {}).get("identity")
    may: dict[str, object] = {
        f"may_{role}": identity is not None and identity.role.includes(role)
        for role in (Role.OPERATE, Role.ADMIN)
    }
    counted = getattr(getattr(scope.get("app"), "state", None), "alarms", None)
    may["alarm_count"] = count_badge(0 if counted is None else counted.last)
    if identity == LOCAL:
        may["store"] = scope["app"].state.runtime.settings.store
    path, query = scope.get("path", ""), scope.get("query_string", b"").decode("ascii", "replace")
    rendering = _Rendering(quote(path) + (f"?{query}" if query else ""), zone)
    token = _RENDERING.set(rendering)
    try:
        found = TEMPLATES.get_template(template)
        rendering.text = found.render(context, identity=identity, here=path, **may)
    finally:
        _RENDERING.reset(token)
    return rendering


def render(request: Request, template: str, /, **context: object) -> HTMLResponse:
    """Render a page, or the requested part of it.

    Raises
    ------
    NotFoundError
        If the page has no such part.
    """
    part: Part | None = request.scope.get("state", {}).get("part")
    runtime = request.app.state.runtime
    with runtime.database.reading() as session:
        zone = plant_time_zone(session, runtime.settings.time_zone)
    rendering = _rendered(request.scope, template, context, zone)
    if part is None:
        return HTMLResponse(rendering.text)
    name = "-".join(filter(None, [*request.scope["path"].split("/"), part.table or part.figure]))
    if part.table is not None:
        if part.table not in rendering.tables:
            raise NotFoundError(f"table: this page has no table {part.table!r} now")
        return _file(rendering.tables[part.table].csv(), name, "csv")
    figure = rendering.figures.get(str(part.figure))
    if figure is None:
        raise NotFoundError(f"figure: this page has no figure {part.figure!r} now")
    if part.format not in figure.formats:
        raise NotFoundError(f"format: {part.figure} is offered as {' and '.join(figure.formats)}")
    return _file(_WRITERS[part.format](figure), name, part.format)


_WRITERS: dict[str, Callable[[Any], str | bytes]] = {
    "csv": lambda series: sheet(*series.sheet),
    "npz": lambda drawn: pack(drawn.arrays),
    "png": lambda drawn: drawn.drawn(),
}
_MEDIA_TYPES = {"csv": f"{CSV}; charset=utf-8", "npz": "application/x-npz", "png": "image/png"}


def _file(content: str | bytes, name: str, suffix: str) -> HTMLResponse:
    """A part of a page as a file. It is an HTMLResponse, because it replaces the page."""
    # A picture is shown, unless the link to it asks for a download.
    shown = "inline" if suffix == "png" else "attachment"
    headers = {
        "Content-Disposition": f'{shown}; filename="{name}.{suffix}"',
        "Cache-Control": "private, no-cache",
    }
    return HTMLResponse(content, media_type=_MEDIA_TYPES[suffix], headers=headers)


@contextmanager
def named_by_field() -> Iterator[None]:
    """Let mistakes of what is made from a form be answered as those of a request: by field."""
    try:
        yield
    except ValidationError as error:
        raise RequestValidationError(error.errors()) from error


def go_to(path: str) -> Response:
    """Redirect after a form. htmx takes the part that it requested from the new page."""
    return RedirectResponse(path, HTTPStatus.SEE_OTHER)


def go_to_job(
    runtime: Runtime, kind: Kind[Payload], payload: Payload, identity: Identity
) -> Response:
    """Enqueue the job that a form asks for, and go to its page."""
    return go_to(f"/jobs/{enqueue(runtime, kind, payload, identity.name).row.id}")


def leave_for(request: Request, path: str) -> Response:
    """Redirect to another page as a whole. htmx needs a header for this."""
    return (
        Response(headers={"HX-Redirect": path}) if "hx-request" in request.headers else go_to(path)
    )


def wants_page(scope: Scope) -> bool:
    """Whether a browser requests a page, and not a resource of the REST interface."""
    headers = Headers(scope=scope)
    is_browser = "text/html" in headers.get("accept", "") or "hx-request" in headers
    return is_browser and not scope.get("path", "").startswith("/v1/")


def error_page(scope: Scope, status: int, document: Mapping[str, object]) -> HTMLResponse:
    """Render a problem document: a page, or for htmx only the message."""
    is_part = "hx-request" in Headers(scope=scope)
    template = "alert.html" if is_part else "error.html"
    page = HTMLResponse(_rendered(scope, template, {"problem": document}).text, status)
    page.headers.update(_NOTICE if is_part else {})
    return page


def login_path(scope: Scope) -> str:
    """The path of the login page, with the wanted page in its query."""
    wanted = scope.get("path", "/")
    query = scope.get("query_string", b"").decode("ascii", "replace")
    return f"/login?next={quote(f'{wanted}?{query}' if query else wanted, '')}"
