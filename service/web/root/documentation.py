"""Styles and scripts, the page at ``/docs``, and the guide at ``/docs/guide``.

The page is Swagger UI from an installed package. The browser requests nothing from outside the
plant.
"""

import mimetypes
from pathlib import Path
from typing import Annotated

from fastapi import APIRouter, Response
from fastapi import Path as Parameter
from fastapi.responses import HTMLResponse

from service.base.errors import NotFoundError
from service.drawing.templates import ASSETS
from service.web.auth.dependencies import READ
from service.web.responses.files import MEDIA_TYPES, KnownFiles, WholeFile
from service.web.responses.pages import GUIDE, go_to, has_guide
from service.web.responses.problems import SECURITY_HEADERS

_FOLDER = Path(str(ASSETS))


router = APIRouter(include_in_schema=False)

_STATIC = Path(__file__).parent / "static"

MOUNTS = {
    "/static": KnownFiles(
        _FOLDER,
        [path.name for path in _FOLDER.iterdir() if path.suffix in MEDIA_TYPES],
        # The URL holds a digest of the content, so browsers may cache it without limit.
        "public, max-age=31536000, immutable",
    ),
    "/docs": KnownFiles(
        _STATIC,
        ["swagger-ui.css", "swagger-ui-bundle.js", "start.js", "docs.css"],
        "max-age=3600",
        packages=[("fastapi_offline", "static")],
    ),
}
"""Scripts and styles of all pages, and those of ``/docs``. They need no key."""


@router.get("/docs")
def get_docs() -> HTMLResponse:
    """The page."""
    return HTMLResponse((_STATIC / "docs.html").read_text(encoding="utf-8"))


_POLICY = SECURITY_HEADERS["Content-Security-Policy"]
# The theme of the guide sets some styles in its pages; scripts stay in files.
_GUIDE_HEADERS = {
    "Content-Security-Policy": f"{_POLICY}; style-src 'self' 'unsafe-inline'",
    "Cache-Control": "max-age=3600",
}


@router.get("/docs/guide", dependencies=[READ])
def get_guide_start() -> Response:
    """Go to the first page of the guide, whose links are relative."""
    return go_to("/docs/guide/index.html")


@router.get("/docs/guide/{path:path}", dependencies=[READ])
def get_guide(path: Annotated[str, Parameter(pattern=r"^[\w./-]{0,200}$")]) -> Response:
    """A page of the guide, if this installation has it."""
    if not has_guide():
        raise NotFoundError("this installation has no guide; `make docs` builds it")
    file = GUIDE / path
    is_inside = file == file.resolve() and file.is_relative_to(GUIDE)  # no "..", no link
    if not (is_inside and file.is_file()):
        raise NotFoundError(f"the guide has no page {path}")
    media_type = mimetypes.guess_type(path)[0] or "application/octet-stream"
    return WholeFile(file, headers=_GUIDE_HEADERS, media_type=media_type)
