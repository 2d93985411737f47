"""Styles and scripts, which nobody needs a key for."""

from pathlib import Path

from service.drawing.templates import ASSETS
from service.web.answers.files import MEDIA_TYPES, KnownFiles

_FOLDER = Path(str(ASSETS))

MOUNT = (
    "/static",
    KnownFiles(
        _FOLDER,
        [path.name for path in _FOLDER.iterdir() if path.suffix in MEDIA_TYPES],
        # They are asked for by the digest of their content, so what a browser has stays right.
        "public, max-age=31536000, immutable",
    ),
)
