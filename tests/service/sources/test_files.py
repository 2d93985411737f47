"""Only regular files of a folder are opened: opening a pipe could block forever."""

import json
import os
from pathlib import Path

import pytest

from heliotwin.folder_camera import read_image
from model.errors import InvalidInputError
from service.base.settings import Settings
from service.sources import documents
from service.sources.files import require_regular
from service.sources.folder import read_declared, read_folder
from service.twin.importing import import_folder
from service.twin.runtime import Runtime
from tests.service.conftest import (
    FakeOperations,
    paint_measurement,
    png,
    properties_document,
    tower_document,
)

pytestmark = pytest.mark.timeout(60)

SURFACE = "AA39/Deflectometry/AA39-2024-deflectometry.h5"


@pytest.fixture
def plant(tmp_path: Path) -> Path:
    """A folder of one heliostat."""
    root = tmp_path / "plant"
    for kind in ("Properties", "Calibration", "Deflectometry"):
        (root / "AA39" / kind).mkdir(parents=True)
    (root / "WRI1030197-tower-measurements.json").write_text(json.dumps(tower_document()))
    (root / "AA39" / "Properties" / "AA39-heliostat-properties.json").write_text(
        json.dumps(properties_document())
    )
    (root / "AA39" / "Calibration" / "1-calibration-properties.json").write_text(
        json.dumps(paint_measurement())
    )
    (root / "AA39" / "Calibration" / "1-flux.png").write_bytes(png())
    return root


@pytest.mark.parametrize("name", [SURFACE, "AA39/Deflectometry/AA39-nurbs-surface.npz"])
def test_a_pipe_for_a_surface_costs_the_surface_and_nothing_else(
    plant: Path, tmp_path: Path, name: str
):
    os.mkfifo(plant / name)
    runtime = Runtime.from_settings(Settings(data_dir=tmp_path / "data"), FakeOperations())
    try:
        runtime.database.upgrade()
        report = import_folder(runtime, read_folder(plant))
    finally:
        runtime.close()
    assert report["counts"]["heliostats new"] == report["counts"]["images new"] == 1
    assert report["skipped"] == {"AA39 surface": f"{plant / name}: no regular file"}


@pytest.mark.parametrize(
    "name",
    [
        "WRI1030197-tower-measurements.json",
        "twin.json",
        "AA39/Properties/AA39-heliostat-properties.json",
        "AA39/Calibration/1-calibration-properties.json",
        "AA39/Calibration/1-calibration-item-stac.json",
        "AA39/Calibration/1-flux.png",
        SURFACE,
    ],
)
def test_no_pipe_of_a_folder_is_waited_for(plant: Path, name: str):
    (plant / name).unlink(missing_ok=True)
    os.mkfifo(plant / name)
    try:
        folder = read_folder(plant)
        measurements = folder.measurements("AA39", with_images=False)
        folder.measured_surface("AA39")
    except InvalidInputError as error:
        message = str(error)
    else:
        message = " ".join(folder.skipped.values())
        taken = [(kind, item.taken_at) for item in measurements for kind in item.images]
        assert message or taken in (
            [],
            [("flux", None)],
        )  # PAINT's images and items are taken where they are files
    assert not message or "no regular file" in message or "no heliostat with a readable" in message


def test_only_regular_files_of_a_bearable_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "file").write_bytes(b"x" * 11)
    (tmp_path / "link").symlink_to(tmp_path / "file")
    os.mkfifo(tmp_path / "pipe")
    assert require_regular(tmp_path / "link") == tmp_path / "link"
    for name, message in (
        ("pipe", "no regular file"),
        (".", "no regular file"),
        ("nothing", "no such file"),
    ):
        with pytest.raises(InvalidInputError, match=message):
            require_regular(tmp_path / name)
    with pytest.raises(InvalidInputError, match="pipe: no regular file"):
        read_image(tmp_path / "pipe")
    with pytest.raises(InvalidInputError, match="pipe: no regular file"):
        read_declared(tmp_path / "pipe")
    monkeypatch.setattr("service.sources.files._MAX_BYTES", 10)
    with pytest.raises(InvalidInputError, match="link: 11 bytes, 10 are the most"):
        require_regular(tmp_path / "link")


def test_json_of_too_many_values_is_not_parsed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """22 million empty objects, which 64 MiB hold, took 7.7 GB."""
    monkeypatch.setattr(documents, "MAX_JSON_VALUES", 10)
    file = tmp_path / "wide.json"
    file.write_text('{"a": [0, 1, 2, 3, 4, 5, 6]}')
    assert documents.read_json(file) == {"a": [0, 1, 2, 3, 4, 5, 6]}
    file.write_text('{"a": [0, 1, 2, 3, 4, 5, 6, {}]}')
    with pytest.raises(
        InvalidInputError, match=r"wide\.json: holds up to 11 values; at most 10 are read"
    ):
        documents.read_json(file)
