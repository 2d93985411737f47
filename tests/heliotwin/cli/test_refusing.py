"""Verbs that look at a store make none; a heliostat's broken file is said; what --until leaves out
is counted.
"""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from heliotwin.cli.main import app
from heliotwin.folder_pointing import calibrate_folder
from service.sources.folder import read_folder
from tests.service.command import ends, heliotwin_on


@pytest.mark.parametrize(
    "verb",
    [
        ("export", "out"),
        ("check",),
        ("backup", "out"),
        ("models", "adopt", "report.json"),
        ("models", "withdraw", "1"),
        ("keys", "withdraw", "calibration"),
        ("times", "times.csv", "--reason", "log"),
    ],
)
def test_without_a_store_a_verb_ends_and_makes_none(tmp_path: Path, verb: tuple[str, ...]):
    (tmp_path / "report.json").write_text('{"verdict": "effect", "effects": []}')
    (tmp_path / "times.csv").write_text("heliostat,id,taken_at\nAA39,1,2024-06-01T12:00:00Z\n")
    before = sorted(tmp_path.iterdir())
    ends(heliotwin_on(tmp_path / "data", *verb), 2, "or make one by `heliotwin serve`")
    assert sorted(tmp_path.iterdir()) == before


@pytest.fixture(scope="module")
def broken(pair_plant: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The demonstration's plant with one more heliostat, whose file was cut off."""
    root = Path(shutil.copytree(pair_plant, tmp_path_factory.mktemp("broken") / "plant"))
    name = next(iter(read_folder(pair_plant).plant.heliostats))
    shutil.copytree(root / name, root / "ZZ99")
    for file in (root / "ZZ99" / "Properties").glob(f"{name}-*"):
        file.unlink()
    (root / "ZZ99" / "Properties" / "ZZ99-heliostat-properties.json").write_text('{"width": 3.2')
    return root


@pytest.mark.parametrize(
    ("verb", "made"),
    [
        (("flux", "--out", "{out}"), "quality.json"),
        (("forecast", "--out", "{out}", "--surfaces", "ideal"), "forecast.json"),
        (("import",), None),
    ],
)
def test_a_broken_heliostat_costs_only_itself_and_is_no_success(
    broken: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    verb: tuple[str, ...],
    made: str | None,
):
    monkeypatch.setenv("HELIOTWIN_DATA_DIR", str(tmp_path / "data"))
    options = [option.format(out=tmp_path / "out") for option in verb[1:]]
    done = heliotwin_on(tmp_path / "data", verb[0], broken, *options, "--json")
    assert done.returncode == 2, done.stderr
    said = done.stderr.strip().splitlines()[-1]
    assert "ZZ99-heliostat-properties.json: is no JSON" in said
    assert said.endswith("all but ZZ99 is done")
    assert "ZZ99" in json.loads(done.stdout)["skipped"]
    assert made is None or (tmp_path / "out" / made).is_file()


def test_a_broken_heliostat_costs_no_mount_of_others(folder: Path, tmp_path: Path):
    (folder / "AB02" / "Properties" / "AB02-heliostat-properties.json").write_text('{"width": 3.2')
    mounts, spots = tmp_path / "mounts.json", tmp_path / "spots.json"
    for verb, out in (("calibrate", mounts), ("spot", spots)):
        options = ["--mounts", mounts] if verb == "spot" else []
        done = heliotwin_on(tmp_path / "data", verb, folder, *options, "--out", out)
        assert done.returncode == 2, done.stderr
        assert "AB02-heliostat-properties.json: is no JSON" in done.stderr
        assert json.loads(out.read_text())


def test_where_nothing_is_left_the_broken_file_is_named(broken: Path, tmp_path: Path):
    root = tmp_path / "plant"
    shutil.copytree(broken / "ZZ99", root / "ZZ99")
    shutil.copy(next(broken.glob("*tower-measurements.json")), root)
    done = heliotwin_on(tmp_path / "data", "flux", root, "--out", tmp_path / "out")
    ends(done, 2, "ZZ99-heliostat-properties.json: is no JSON")


def test_until_says_how_many_without_a_time_it_leaves_out(folder: Path, tmp_path: Path):
    out = tmp_path / "mounts.json"
    done = CliRunner().invoke(
        app, ["calibrate", str(folder), "--out", str(out), "--until", "2024-05-10"]
    )
    assert done.exit_code == 0, done.output
    report: dict[str, Any] = json.loads(out.read_text())
    assert report["undated"] == {"used": 0, "left_out": 5}
    assert report["heliostats"]["AA39"]["measurements"] == 6
    assert "5 measurements of an unknown time are left out" in " ".join(done.stderr.split())
    whole = calibrate_folder(read_folder(folder), out)
    assert whole["undated"] == {"used": 5, "left_out": 0}
