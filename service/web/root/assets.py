"""Styles and scripts, which nobody needs a key for."""

from fastapi import APIRouter, Response

from service.base.faults import NotFoundError
from service.drawing.templates import ASSETS

router = APIRouter(include_in_schema=False)

_TYPES = {"css": "text/css", "js": "text/javascript", "svg": "image/svg+xml"}
_SERVED = {entry.name for entry in ASSETS.iterdir() if entry.name.rpartition(".")[2] in _TYPES}

# Assets are asked for by the digest of their content, so what a browser has stays right.
_FOREVER = {"Cache-Control": "public, max-age=31536000, immutable"}


@router.get("/static/{name}")
def get_static(name: str) -> Response:
    """A style or script."""
    if name not in _SERVED:
        raise NotFoundError("there is no such file")
    media_type = _TYPES[name.rpartition(".")[2]]
    return Response(ASSETS.joinpath(name).read_bytes(), media_type=media_type, headers=_FOREVER)
