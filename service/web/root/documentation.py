"""The page at ``/docs``: Swagger UI from an installed package, so that no request leaves the plant."""

from importlib.resources import files
from typing import Literal

from fastapi import APIRouter
from fastapi.responses import HTMLResponse, Response

router = APIRouter(include_in_schema=False)

_PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>heliotwin: documentation</title>
<link rel="icon" href="data:,">
<link rel="stylesheet" href="/docs/swagger-ui.css">
</head>
<body>
<div id="swagger-ui"></div>
<script src="/docs/swagger-ui-bundle.js"></script>
<script src="/docs/start.js"></script>
</body>
</html>
"""

# A file of its own: the content security policy lets no script run that stands in a page. Without validatorUrl the
# page would ask a server of Swagger's whether the document is valid.
_START = 'SwaggerUIBundle({url: "/openapi.json", dom_id: "#swagger-ui", deepLinking: true, validatorUrl: null});\n'

_TYPES = {"css": "text/css", "js": "text/javascript"}


@router.get("/docs")
def get_docs() -> HTMLResponse:
    """The page."""
    return HTMLResponse(_PAGE)


@router.get("/docs/{asset}")
def get_docs_asset(asset: Literal["swagger-ui.css", "swagger-ui-bundle.js", "start.js"]) -> Response:
    """What the page loads."""
    text = _START if asset == "start.js" else files("fastapi_offline").joinpath("static", asset).read_text("utf-8")
    return Response(text, media_type=_TYPES[asset.rpartition(".")[2]], headers={"Cache-Control": "max-age=3600"})
