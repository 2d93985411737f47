"""The page at ``/docs``: Swagger UI from an installed package.

The browser requests nothing from outside the plant.
"""

from pathlib import Path

from fastapi import APIRouter
from fastapi.responses import HTMLResponse

from service.web.responses.files import KnownFiles

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

MOUNT = (
    "/docs",
    KnownFiles(
        Path(__file__).parent / "static",
        ["swagger-ui.css", "swagger-ui-bundle.js", "start.js"],
        "max-age=3600",
        packages=[("fastapi_offline", "static")],
    ),
)
"""Scripts and styles of the page."""


@router.get("/docs")
def get_docs() -> HTMLResponse:
    """The page."""
    return HTMLResponse(_PAGE)
