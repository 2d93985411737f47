"""``heliotwin plant``: the template is a plant at once; what is understood is said and drawn."""

import json
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
import yaml
from PIL import Image

from service.sources.plant_file import read_plant
from service.sources.plant_template import template_text
from tests.service.command import ends, heliotwin
from tests.service.sources.plant_files import PLANT, gemasolar, ps10, write_plant


@pytest.fixture
def template(tmp_path: Path) -> Path:
    done = heliotwin("plant", "new", tmp_path / "plant.yaml")
    assert done.returncode == 0, done.stderr
    return tmp_path / "plant.yaml"


def test_template_passes_the_check(template: Path):
    done = heliotwin("plant", "check", template)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("my-plant: 173 heliostats, 6,851 m2 of mirrors\n")
    assert "receiver main: cylinder" in done.stdout
    assert done.stderr == ""


def test_template_replaces_nothing(template: Path):
    before = template.read_bytes()
    ends(heliotwin("plant", "new", template), 2, f"{template} exists")
    template.unlink()
    ends(heliotwin("plant", "new", template), 2, "layout.csv exists")
    assert not template.exists()
    assert before == template_text().encode()


def test_report_has_counts_areas_and_assumptions(tmp_path: Path):
    done = heliotwin("plant", "check", write_plant(tmp_path), "--json")
    report = json.loads(done.stdout)
    assert report["heliostats"] == 3
    assert report["types"]["large"]["facets"] == 28
    assert report["types"]["large"]["heliostats"] == 2
    plant = read_plant(tmp_path / "plant.yaml").plant
    areas = [heliostat.area for heliostat in plant.heliostats.values()]
    assert report["mirror_area_m2"] == pytest.approx(sum(areas), abs=1e-3)
    assert report["receivers"]["main"] == {
        "kind": "cylinder",
        "area_m2": pytest.approx(2 * np.pi * 8 * 16, abs=1e-3),
        "absorptance": 0.94,
        "heliostats": 2,
    }
    assert "heliostat_types.small.reflectance: 1" in report["assumed"]
    assert "heliostat_types.large.reflectance: 0.95" not in report["assumed"]
    assert report["warnings"] == []


def test_mistake_ends_with_its_line(tmp_path: Path):
    path = write_plant(tmp_path, PLANT.replace("kind: azimuth_elevation", "kind: az-el"))
    said = "plant.yaml, line 4: heliostat_types.large.mount.kind: 'az-el' is none of"
    ends(heliotwin("plant", "check", path), 2, said)
    ends(heliotwin("plant", "show", path, "--out", tmp_path / "p.png"), 2, said)
    ends(heliotwin("plant", "check", tmp_path / "none.yaml"), 2, "no such file")


@pytest.mark.parametrize(
    "make",
    [ps10, *(pytest.param(make, marks=pytest.mark.full) for make in (write_plant, gemasolar))],
)
def test_plant_is_drawn(tmp_path: Path, make: Any):
    out = tmp_path / "pictures" / "plant.png"
    done = heliotwin("plant", "show", make(tmp_path), "--out", out)
    assert done.returncode == 0, done.stderr
    with Image.open(out) as picture:
        assert min(picture.size) > 500
        colours = np.unique(np.asarray(picture.convert("RGB")).reshape(-1, 3), axis=0)
    assert len(colours) > 10


def test_schema_accepts_what_is_read_and_refuses_mistakes(tmp_path: Path):
    schema = json.loads(heliotwin("plant", "schema").stdout)
    validator = jsonschema.Draft202012Validator(schema)
    validator.check_schema(schema)
    for text in (PLANT, template_text()):
        validator.validate(yaml.safe_load(text))
    for old, new in [
        ("kind: azimuth_elevation", "kind: az-el"),
        ("reflectance:", "reflectence:"),
        ("radius_m: 8, height_m: 16", "radius_m: 8"),
        ("shape: pillbox", "shape: disc"),
    ]:
        assert not validator.is_valid(yaml.safe_load(PLANT.replace(old, new, 1))), new
