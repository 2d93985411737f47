"""What the tests of verbs share: a made plant."""

from pathlib import Path

import pytest

from service.cli.demo_plant import write_plant


@pytest.fixture(scope="session")
def made_plant(tmp_path_factory) -> Path:
    """The demonstration's plant with few images and rays."""
    root = tmp_path_factory.mktemp("plant")
    write_plant(root, images=4, rays=60_000)
    return root
