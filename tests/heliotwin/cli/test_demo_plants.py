"""``heliotwin demo --plant``: photographs of any plant, and the embedded plant that is another."""

import json
from collections.abc import Mapping
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from heliotwin.cli import demo
from heliotwin.demo.described import Demonstrated, write_southern_plant
from heliotwin.demo.photographs import TargetCamera
from heliotwin.demo.plant import DRIVES, POSITIONS, TARGET
from model.mount import Mount
from model.plant import Heliostat
from model.prior import default_prior
from model.tracing import Optics
from service.sources.folder import read_folder
from service.sources.plant_template import template_text
from tests.service.command import ends, heliotwin

LAYOUT = "name,type,east_m,north_m,up_m\nA1,standard,-20,90,0\n"


def write_small(folder: Path, **changes: str) -> Path:
    """The template with one heliostat of one facet."""
    text = template_text().replace(
        "rows: 4, columns: 3, width_m: 3.0", "rows: 1, columns: 1, width_m: 3.0"
    )
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new)
    path = folder / "plant.yaml"
    path.write_text(text)
    (folder / "layout.csv").write_text(LAYOUT)
    return path


@pytest.mark.full
def test_mirrors_of_a_plants_file_are_photographed_and_found(tmp_path: Path):
    plant = write_small(tmp_path)
    done = heliotwin("demo", "--plant", plant, "--out", tmp_path / "out", "--json")
    assert done.returncode == 0, done.stderr
    report, out = json.loads(done.stdout), tmp_path / "out" / "my-plant"
    assert report == json.loads((out / "report.json").read_text())
    for one in report["heliostats"]:
        assert one["accuracy_network"] is None  # no network predicts mirrors of one facet
        assert one["accuracy_refined"] > max(0.95, one["accuracy_ideal"])
        assert all((out / picture).is_file() for picture in one["pictures"])
    assert report["field"]["field"]["heliostats"] == 1
    page = (out / "report.html").read_text()
    for picture in ("plant.png", "field.png"):
        assert picture in page
        assert (out / picture).is_file()


@pytest.mark.full
def test_second_embedded_plant_is_what_juelich_is_not(tmp_path: Path):
    file = write_southern_plant(tmp_path / "southern")
    demonstrated = Demonstrated.read(file, 1)
    demonstrated.write(tmp_path / "plant", images=1, rays=1000)
    (named,) = (mirror.name for mirror in demonstrated.mirrors)
    folder = read_folder(tmp_path / "plant")
    assert list(folder.plant.heliostats) == [named]
    whole = read_folder(tmp_path / "plant", whole_field=True).plant
    assert len(whole.heliostats) == 600
    assert {len(heliostat.facets) for heliostat in whole.heliostats.values()} == {28}
    assert whole.origin[0] < 0
    (taken,) = folder.measurements(named)
    assert list(taken.images) == ["raw"]
    assert taken.motor_position is not None


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"normal: [0, 1, 0] ": "normal: [0, -1, 0]"}, "no heliostat's light meets it"),
        ({"width_m: 8": "width: 8"}, "width"),
    ],
)
def test_a_plant_that_cannot_be_photographed_says_why(
    tmp_path: Path, changes: dict[str, str], said: str
):
    done = heliotwin("demo", "--plant", write_small(tmp_path, **changes), "--out", tmp_path / "out")
    ends(done, 2, said)


def test_data_and_plant_are_not_both_given(tmp_path: Path):
    done = heliotwin("demo", "--plant", write_small(tmp_path), "--data", tmp_path)
    ends(done, 2, "--data, --plant: give one of them")


@pytest.mark.full
def test_photographs_of_two_mirrors_at_once_are_those_of_one_after_the_other():
    """`Camera.skip` draws what a mirror's photographs draw."""
    camera = TargetCamera(TARGET, 50.9, Optics(), rays=1000)
    place = np.array(POSITIONS["AB12"])
    mirror = Heliostat.juelich("AB12", place, 80.0, mount=Mount.juelich(DRIVES))
    taken, skipped = np.random.default_rng(1), np.random.default_rng(1)
    camera.photograph(mirror, default_prior().mean, 2, taken)
    camera.skip(2, skipped)
    assert taken.bit_generator.state == skipped.bit_generator.state


def test_each_part_is_announced_with_its_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    made: list[str] = []

    def run_demo(root: Path, *_: object) -> Mapping[str, object]:
        made.append(root.parent.name)
        return {}

    def seed_field(root: Path, store: Path, counting: Any) -> None:
        step = counting(2)
        step("A")
        step("B")

    monkeypatch.setattr(demo, "write_plant", lambda root, progress: None)
    monkeypatch.setattr(demo, "run_demo", run_demo)
    monkeypatch.setattr(demo, "_demonstrate", lambda *_: run_demo(tmp_path / "southern" / "plant"))
    monkeypatch.setattr(demo, "seed_field", seed_field)
    said = StringIO()
    demo.run_demos(None, None, tmp_path / "out", Console(file=said, width=100))
    parts = [line for line in said.getvalue().splitlines() if " of 3: " in line]
    assert [part[:7] for part in parts] == ["1 of 3:", "2 of 3:", "3 of 3:"]
    assert all("minute" in part for part in parts)
    assert made == ["out", "southern"]
    assert "2/2" in said.getvalue()
    assert "None" not in said.getvalue()
