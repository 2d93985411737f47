"""The build backend: setuptools, after the guide that the service shows at ``/docs/guide``.

A wheel and an editable installation have the guide. Sphinx is in pip's build environment only.
``python -m docs.backend`` builds the guide alone, and fails on warnings.
"""

import shutil
import sys
import tomllib
from pathlib import Path
from typing import Any

from setuptools import build_meta
from setuptools.build_meta import *  # noqa: F403 - hooks that stay as they are

ROOT = Path(__file__).parents[1]
GUIDE = ROOT / "service" / "web" / "root" / "guide"


def build_guide(*options: str) -> None:
    """Build the guide; SystemExit if Sphinx fails."""
    from sphinx.cmd.build import build_main

    shutil.rmtree(GUIDE, ignore_errors=True)
    doctrees = str(ROOT / "build" / "doctrees")
    if code := build_main(["-q", *options, "-d", doctrees, str(ROOT / "docs"), str(GUIDE)]):
        raise SystemExit(code)


def _tools() -> list[str]:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    tools: list[str] = project["optional-dependencies"]["docs"]
    return tools


def get_requires_for_build_wheel(settings: Any = None) -> list[str]:
    """Packages for `build_wheel`."""
    return [*build_meta.get_requires_for_build_wheel(settings), *_tools()]


def get_requires_for_build_editable(settings: Any = None) -> list[str]:
    """Packages for `build_editable`."""
    return [*build_meta.get_requires_for_build_editable(settings), *_tools()]


def build_wheel(folder: str, settings: Any = None, metadata: str | None = None) -> str:
    """Build the guide, then the wheel."""
    build_guide()
    shutil.rmtree(ROOT / "build" / "lib", ignore_errors=True)  # has files that were deleted since
    return build_meta.build_wheel(folder, settings, metadata)


def build_editable(folder: str, settings: Any = None, metadata: str | None = None) -> str:
    """Build the guide, then the editable wheel."""
    build_guide()
    return build_meta.build_editable(folder, settings, metadata)


if __name__ == "__main__":
    build_guide("-a", "-W", "--keep-going", *sys.argv[1:])
