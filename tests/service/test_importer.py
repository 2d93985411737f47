from pathlib import Path

from service import store
from service.importer import import_folder
from service.paint import read_folder
from service.runtime import Runtime
from service.settings import Settings


def test_a_second_import_changes_nothing(stj: Path, tmp_path: Path):
    """Every heliostat, image and measured surface of the real folder, once; what has no image is named."""
    folder = read_folder(stj)
    runtime = Runtime.from_settings(Settings(data_dir=tmp_path))
    try:
        runtime.database.upgrade()
        first, second = import_folder(runtime, folder), import_folder(runtime, folder)
        with runtime.database.reading() as session:
            stored = store.counts(session)
    finally:
        runtime.close()
    assert first["counts"]["heliostats new"] == 7
    assert first["counts"]["surfaces new"] == 3
    assert sum(n for what, n in first["counts"].items() if what.startswith("images")) == 54
    assert all("unchanged" in what for what in second["counts"])
    assert stored["heliostats"] == 7
    assert stored["measurements"] == 54
    assert first["skipped"] == second["skipped"]
    assert first["skipped"]["AA39/156500"] == "no image"
