"""Templates to answers: what every page knows, and what a browser gets in place of JSON."""

import hashlib
import json
from functools import cache
from http import HTTPStatus
from typing import Any
from urllib.parse import quote

from fastapi import Request, Response
from fastapi.responses import HTMLResponse, RedirectResponse
from jinja2 import Environment
from starlette.datastructures import Headers
from starlette.types import Scope

from service.drawing.templates import ASSETS, environment
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


def _environment() -> Environment:
    made = environment("service.web.pages", "service.drawing")
    made.globals.update(asset=asset, htmx_settings=json.dumps(_HTMX))
    return made


TEMPLATES = _environment()
"""The templates of the pages."""


def _page(scope: Scope, template: str, status: int, context: dict[str, Any]) -> HTMLResponse:
    identity: Identity | None = scope.get("state", {}).get("identity")
    may = {f"may_{role}": identity is not None and identity.role.includes(role) for role in (Role.OPERATE, Role.ADMIN)}
    text = TEMPLATES.get_template(template).render(context, identity=identity, here=scope.get("path", ""), **may)
    return HTMLResponse(text, status)


def render(request: Request, template: str, status: int = HTTPStatus.OK, **context: Any) -> HTMLResponse:
    """A page."""
    return _page(request.scope, template, status, context)


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
