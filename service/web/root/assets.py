"""Styles and scripts, which need no key."""

from pathlib import Path

from service.drawing.templates import ASSETS
from service.web.responses.files import MEDIA_TYPES, KnownFiles

_FOLDER = Path(str(ASSETS))

MOUNT = (
    "/static",
    KnownFiles(
        _FOLDER,
        [path.name for path in _FOLDER.iterdir() if path.suffix in MEDIA_TYPES],
        # The URL holds a digest of the content, so browsers may cache it without limit.
        "public, max-age=31536000, immutable",
    ),
)
