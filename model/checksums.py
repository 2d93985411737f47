"""Check that shipped weights are those of their model cards, and not others of the same name."""

import hashlib
import json
from pathlib import Path

from model.errors import WeightsError


def read_verified(path: Path, remedy: str = "install heliotwin again") -> bytes:
    """Read weights, and compare their SHA-256 with their model card, the JSON file of the same
    name.

    The ``remedy`` is part of the error's message.

    Raises
    ------
    WeightsError
        If the file or its card cannot be read, or they differ.
    """
    try:
        content = path.read_bytes()
        expected = json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))["sha256"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise WeightsError(
            f"{path.name} or its model card cannot be read ({type(error).__name__}); {remedy}"
        ) from error
    found = hashlib.sha256(content).hexdigest()
    if found != expected:
        raise WeightsError(
            f"{path.name} is damaged or was replaced: its SHA-256 is {found[:12]}.. and its model"
            f" card says {str(expected)[:12]}..; {remedy}"
        )
    return content


def digests(path: Path) -> dict[str, str]:
    """Digests of a file for its model card: ``weights``, its name in predictions; ``sha256``."""
    sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
    return {"weights": f"{path.stem}-{sha256[:12]}", "sha256": sha256}
