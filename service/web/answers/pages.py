"""Templates to answers: what every page knows, and what a browser gets in place of JSON."""

import hashlib
import json
from collections.abc import Callable
from contextvars import ContextVar
from dataclasses import dataclass, field
from functools import cache
from http import HTTPStatus
from typing import Any
from urllib.parse import quote, urlencode

from fastapi import Request, Response
from fastapi.responses import HTMLResponse, RedirectResponse
from jinja2 import Environment
from starlette.datastructures import Headers
from starlette.types import Scope

from service.base.arrays import pack
from service.base.faults import NotFoundError
from service.drawing.charts import Figure
from service.drawing.templates import ASSETS, environment
from service.web.answers.parts import Part
from service.web.answers.sheets import CSV, FILTERS, sheet, table_of
from service.web.door.security import Identity, Role

# What htmx may do: no code from text, no styles of its own, which the content security policy would refuse. It shows
# errors' answers too.
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

# Where htmx puts an error, whatever part of the page it asked for: `base.html` has room for it.
_NOTICE = {"HX-Retarget": "#notice", "HX-Reswap": "innerHTML", "HX-Reselect": ".alert", "HX-Push-Url": "false"}


@cache
def asset(name: str) -> str:
    """The path of a style or script; another for other content, so that browsers may keep it."""
    digest = hashlib.sha256(ASSETS.joinpath(name).read_bytes()).hexdigest()[:12]
    return f"/static/{name}?v={digest}"


@dataclass
class _Rendering:
    """A page while it is rendered: where it is, and the figures that it shows, by their names."""

    page: str
    figures: dict[str, Figure] = field(default_factory=dict)

    def link(self, **part: str) -> str:
        """Where a part of the page is."""
        return f"{self.page}{'&' if '?' in self.page else '?'}{urlencode(part)}"


# Macros, which know nothing of the page that they stand in, link to its parts.
_RENDERING: ContextVar[_Rendering] = ContextVar("rendering")


def _link_to_table(name: str) -> str:
    return _RENDERING.get().link(table=name)


def _link_to_figure(name: str, figure: Figure) -> str:
    """Where a figure's files are, but for the ``format``; it is theirs as long as the page shows it."""
    _RENDERING.get().figures[name] = figure
    return _RENDERING.get().link(figure=name)


def _environment() -> Environment:
    made = environment("service.web.pages", "service.drawing")
    made.globals.update(asset=asset, htmx_settings=json.dumps(_HTMX))
    made.globals.update(link_to_table=_link_to_table, link_to_figure=_link_to_figure)
    return made


TEMPLATES = _environment()
"""The templates of the pages."""

_SHEETS = _environment()  # the same, with numbers that can be read
_SHEETS.filters.update(FILTERS)


def _text(scope: Scope, template: str, context: dict[str, Any], templates: Environment) -> tuple[str, _Rendering]:
    identity: Identity | None = scope.get("state", {}).get("identity")
    may = {f"may_{role}": identity is not None and identity.role.includes(role) for role in (Role.OPERATE, Role.ADMIN)}
    path, query = scope.get("path", ""), scope.get("query_string", b"").decode("ascii", "replace")
    rendering = _Rendering(quote(path) + (f"?{query}" if query else ""))
    token = _RENDERING.set(rendering)
    try:
        return templates.get_template(template).render(context, identity=identity, here=path, **may), rendering
    finally:
        _RENDERING.reset(token)


def _page(scope: Scope, template: str, status: int, context: dict[str, Any]) -> HTMLResponse:
    return HTMLResponse(_text(scope, template, context, TEMPLATES)[0], status)


def render(request: Request, template: str, status: int = HTTPStatus.OK, **context: Any) -> HTMLResponse:
    """A page, or the part of it that is asked for.

    Raises
    ------
    NotFoundError
        Where the page has no such part.
    """
    part: Part | None = request.scope.get("state", {}).get("part")
    if part is None:
        return _page(request.scope, template, status, context)
    name = "-".join(filter(None, [*request.scope["path"].split("/"), part.table or part.figure]))
    if part.table is not None:
        columns, rows = table_of(_text(request.scope, template, context, _SHEETS)[0], part.table)
        return _file(sheet(columns, rows), name, "csv")
    figure = _text(request.scope, template, context, TEMPLATES)[1].figures.get(str(part.figure))
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
    """A part as a file: in place of the page, hence of its type."""
    headers = {"Content-Disposition": f'attachment; filename="{name}.{suffix}"', "Cache-Control": "private, no-cache"}
    return HTMLResponse(content, media_type=_MEDIA_TYPES[suffix], headers=headers)


def go_to(path: str) -> Response:
    """An answer to a form: look there. htmx takes the part that it asked for from that page."""
    return RedirectResponse(path, HTTPStatus.SEE_OTHER)


def leave_for(request: Request, path: str) -> Response:
    """The same where the answer is another page as a whole, which htmx has to be told."""
    return Response(headers={"HX-Redirect": path}) if "hx-request" in request.headers else go_to(path)


def wants_page(scope: Scope) -> bool:
    """Whether a person's browser asks, and not for a part of the REST interface."""
    headers = Headers(scope=scope)
    is_browser = "text/html" in headers.get("accept", "") or "hx-request" in headers
    return is_browser and not scope.get("path", "").startswith("/v1/")


def error_page(scope: Scope, document: dict[str, Any]) -> HTMLResponse:
    """A problem document for a person: a page, or for htmx the sentence alone."""
    is_part = "hx-request" in Headers(scope=scope)
    page = _page(scope, "alert.html" if is_part else "error.html", document["status"], {"problem": document})
    page.headers.update(_NOTICE if is_part else {})
    return page


def login_path(scope: Scope) -> str:
    """Where a browser without a key goes, and comes back from."""
    wanted = scope.get("path", "/")
    query = scope.get("query_string", b"").decode("ascii", "replace")
    return f"/login?next={quote(f'{wanted}?{query}' if query else wanted, '')}"
