"""Tests have the same sets with or without the real data: their sheets are drawn."""

from collections.abc import Iterator

import pytest

from tests.undeclared import camera


@pytest.fixture(scope="session", autouse=True)
def drawn_sheets() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(camera, "sheet", camera.drawn_sheet)
        yield
