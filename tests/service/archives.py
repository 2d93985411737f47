"""ZIP files of measurement folders."""

import io
from pathlib import Path
from zipfile import ZIP_DEFLATED, ZipFile


def zipped(root: Path, top: str = "") -> bytes:
    """The ZIP file of a folder, whose files are at ``top``."""
    buffer = io.BytesIO()
    with ZipFile(buffer, "w", ZIP_DEFLATED) as archive:
        for path in sorted(root.rglob("*")):
            archive.write(path, f"{top}{path.relative_to(root)}")
    return buffer.getvalue()
