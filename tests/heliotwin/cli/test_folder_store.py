"""A folder on the command line and the same folder in a store: equal surfaces, mounts and
studies.
"""

import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from heliotwin.folder import predict_folder
from heliotwin.folder_pointing import calibrate_folder
from heliotwin.folder_store import open_folder
from heliotwin.folder_study import photographs_of
from service.base.arrays import unpack
from service.base.settings import Settings
from service.sources.folder import read_folder
from service.twin.calibration import calibrate_store
from service.twin.importing import import_folder
from service.twin.runtime import Runtime
from service.twin.studies.study import StudyIn, load_study_inputs
from service.twin.surfaces.prediction import predict_surface
from tests.service.conftest import QUIET


@pytest.fixture
def stored(pair_plant: Path, tmp_path: Path) -> Iterator[Runtime]:
    """A store into which the made plant was imported."""
    runtime = Runtime.from_settings(Settings(data_dir=tmp_path / "store", **QUIET))
    runtime.database.upgrade()
    import_folder(runtime, read_folder(pair_plant))
    yield runtime
    runtime.close()


@pytest.mark.full
def test_folder_and_store_are_one_plant(pair_plant: Path, stored: Runtime, tmp_path: Path):
    folder = read_folder(pair_plant)
    names = list(folder.plant.heliostats)

    with open_folder(folder) as opened:
        of_folder = photographs_of(opened)
    with stored.database.reading() as session:
        inputs = load_study_inputs(session, StudyIn(surfaces="measured"))
    assert of_folder.skipped == inputs.skipped == {}
    by_key = {one.key: one for one in inputs.photographs}
    assert by_key.keys() == {one.key for one in of_folder.photographs}
    for one in of_folder.photographs:
        same = by_key[one.key]
        assert np.array_equal(one.image, same.image)
        assert np.array_equal(one.setup.spot, same.setup.spot)
        assert one.setup.taken_at == same.setup.taken_at
        np.testing.assert_allclose(one.setup.control_points, same.setup.control_points, atol=1e-12)

    mounts = calibrate_folder(folder, tmp_path / "mounts.json")["heliostats"]
    calibrated = calibrate_store(stored, names).done.mounts
    assert mounts.keys() == calibrated.keys()
    for name, mount in calibrated.items():
        found = [entry["value"] for entry in mounts[name]["parameters"].values()]
        assert found == np.round(mount.parameters, 9).tolist()

    predicted = predict_folder(folder, tmp_path / "predicted")["heliostats"]
    for name in names:
        row = predict_surface(stored, name).row
        with np.load(tmp_path / f"predicted/{name}/Deflectometry/{name}-nurbs-surface.npz") as made:
            assert np.array_equal(made["z"], unpack(row.arrays)["z"])
        assert {one.identifier for one in row.measurements} == set(predicted[name]["images"])


@pytest.mark.full
def test_an_image_that_two_measurements_have_counts_once(pair_plant: Path, tmp_path: Path):
    root = tmp_path / "plant"
    shutil.copytree(pair_plant, root)
    images = sorted((root / "AB12" / "Calibration").glob("*.png"))
    images[1].write_bytes(images[0].read_bytes())
    with open_folder(read_folder(root)) as opened:
        accepted, refused = opened.photographs("AB12")
    assert len(accepted) == len(images) - 1
    assert "the image of another measurement" in next(iter(refused.values()))
