"""The composition's file for the tests."""

import re
from typing import Any

import pytest
import yaml

from tests.docker.files import DOCKER


def _substituted(text: str) -> str:
    """The file with the defaults of its ``${NAME:-default}``."""
    return re.sub(r"\$\{\w+:-([^}]*)\}", r"\1", text)


@pytest.fixture(scope="module")
def compose() -> dict[str, Any]:
    document: dict[str, Any] = yaml.safe_load(
        _substituted((DOCKER / "compose.yaml").read_text(encoding="utf-8"))
    )
    return document
