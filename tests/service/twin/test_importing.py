import json
import os
from collections import Counter
from pathlib import Path

import pytest
from sqlalchemy import select

from model.sunshape import Pillbox
from service import store
from service.base.settings import Settings
from service.base.validation import is_text
from service.sources.folder import read_folder
from service.store import audit
from service.store.tables import DriftRow
from service.twin import model_versions
from service.twin.importing import import_folder
from service.twin.runtime import Runtime
from tests.service.conftest import paint_measurement, properties_document, tower_document


@pytest.mark.full
def test_a_second_import_changes_nothing(stj: Path, tmp_path: Path):
    """Every heliostat, image, position and measured surface of the real folder, once."""
    folder = read_folder(stj)
    runtime = Runtime.from_settings(Settings(data_dir=tmp_path))
    try:
        runtime.database.upgrade()
        first = import_folder(runtime, folder, actor="cli tester")
        with runtime.database.reading() as session:
            entries = audit.entries(session, 100)
        second = import_folder(runtime, folder)
        with runtime.database.reading() as session:
            stored = store.counts(session)
            assert len(audit.entries(session, 100)) == len(entries)
            # Photographs of an archive do not measure the drift of the current twin.
            assert session.scalars(select(DriftRow)).all() == []
    finally:
        runtime.close()
    heliostats = len([*stj.glob("*/Properties/*-heliostat-properties.json")])
    surfaces = len([*stj.glob("*/Deflectometry")])
    images = sum(n for what, n in first["counts"].items() if what.startswith("images"))
    assert first["counts"]["heliostats new"] == heliostats >= 7
    assert first["counts"]["surfaces new"] == surfaces >= 3
    assert images >= 54
    assert all("unchanged" in what for what in second["counts"])
    assert stored["heliostats"] == heliostats
    assert stored["measurements"] == images + first["counts"]["positions new"] >= 59
    assert first["skipped"] == second["skipped"] == {}
    assert {entry.actor for entry in entries} == {"cli tester"}
    actions = Counter(entry.action for entry in entries)
    assert actions == {"plant.set": 1, "heliostat.set": heliostats, "surface.imported": surfaces}


def test_declared_model_of_a_folder_is_the_store_s(tmp_path: Path):
    declared = {"sun": {"shape": "pillbox", "half_angle_mrad": 4.65}, "effects": []}
    properties = tmp_path / "folder" / "AA39" / "Properties" / "AA39-heliostat-properties.json"
    properties.parent.mkdir(parents=True)
    properties.write_text(json.dumps(properties_document()))
    (tmp_path / "folder" / "plant-tower-measurements.json").write_text(json.dumps(tower_document()))
    (tmp_path / "folder" / "twin.json").write_text(json.dumps({"declared": declared}))
    runtime = Runtime.from_settings(Settings(data_dir=tmp_path / "data"))
    try:
        runtime.database.upgrade()
        folder = read_folder(tmp_path / "folder")
        for outcome in ("changed", "unchanged"):
            assert import_folder(runtime, folder)["counts"][f"declared models {outcome}"] == 1
        with runtime.database.reading() as session:
            assert (
                model_versions.get_model(session).optics.sun_shape
                == folder.model.optics.sun_shape
                == Pillbox(4.65 * 1e-3)
            )
    finally:
        runtime.close()


def test_names_of_files_that_are_no_text_are_reported_as_text(tmp_path: Path):
    """Half characters in a report of an import cannot be answered as JSON."""
    root = tmp_path / "folder"
    calibration = root / "AA39" / "Calibration"
    calibration.mkdir(parents=True)
    (root / "AA39" / "Properties").mkdir()
    (root / "AA39" / "Properties" / "AA39-heliostat-properties.json").write_text(
        json.dumps(properties_document())
    )
    (root / "plant-tower-measurements.json").write_text(json.dumps(tower_document()))
    document = json.dumps(paint_measurement())
    for name in (b"\xff7", b"a\x1b[31m"):
        file = os.fsdecode(os.fsencode(calibration) + b"/" + name + b"-calibration-properties.json")
        Path(file).write_text(document)
    runtime = Runtime.from_settings(Settings(data_dir=tmp_path / "data"))
    try:
        runtime.database.upgrade()
        report = import_folder(runtime, read_folder(root))
    finally:
        runtime.close()
    assert {"AA39/\\udcff7", "AA39/a\\x1b[31m"} <= set(report["skipped"])
    assert is_text(json.dumps(report, ensure_ascii=False))
