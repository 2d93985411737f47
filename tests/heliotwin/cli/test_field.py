"""``heliotwin field``: from a plant file to the map of a receiver and each heliostat's losses."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from service.sources.plant_file import read_plant
from tests.service.command import ends, heliotwin
from tests.service.sources.plant_files import gemasolar, ps10, write_plant

LAYOUT = """\
name,type,east_m,north_m,up_m
A1,large,0,200,0
A2,large,-50,220,0
A3,large,-2,216,0
B1,small,30,120,-1.5
"""

FACTORS = ("cosine", "shading", "blocking", "reflectance", "attenuation", "intercept")


@pytest.fixture
def plant(tmp_path: Path) -> Path:
    return write_plant(tmp_path / "plant", layout=LAYOUT)


def field(plant: Path, receiver: str, *options: object) -> tuple[np.ndarray, dict[str, Any]]:
    out = plant.parent / "out"
    done = heliotwin("field", plant, "--receiver", receiver, "--out", out, *options)
    assert done.returncode == 0, done.stderr
    return np.load(out / "flux.npz")["flux"], json.loads((out / "field.json").read_text())


@pytest.mark.parametrize(
    ("receiver", "area_m2"), [("main", 2 * np.pi * 8 * 16), ("board", 8 * 6.0)]
)
def test_every_watt_is_accounted_for(plant: Path, receiver: str, area_m2: float):
    flux, report = field(plant, receiver, "--sun", 170, 50, "--dni", 850)
    total, single = report["field"], report["by_heliostat"]
    assert report["sun"] == {"azimuth_deg": 170, "elevation_deg": 50}
    assert (report["dni_w_m2"], report["receiver"]) == (850, receiver)
    areas = {name: one.area for name, one in read_plant(plant).plant.heliostats.items()}
    assert total["heliostats"] == len(single) == 4
    assert total["mirror_area_m2"] == pytest.approx(sum(areas.values()))
    assert total["incident_w"] == pytest.approx(850 * sum(areas.values()))
    for name, one in single.items():
        product = np.prod([one[factor] for factor in FACTORS])
        assert one["intercepted_w"] == pytest.approx(850 * areas[name] * product, rel=1e-6)
        assert one["optical_efficiency"] == pytest.approx(product * one["absorptance"])
    assert total["intercepted_w"] == pytest.approx(sum(o["intercepted_w"] for o in single.values()))
    product = np.prod([total[factor] for factor in FACTORS])
    assert total["intercepted_w"] == pytest.approx(total["incident_w"] * product, rel=1e-6)
    assert total["absorbed_w"] == pytest.approx(total["intercepted_w"] * total["absorptance"])
    assert flux.sum() * area_m2 / flux.size == pytest.approx(total["intercepted_w"], rel=1e-3)
    assert flux.max() == pytest.approx(total["peak_w_m2"])
    assert report["skipped"] == {}
    # A3 is in front of A1, between it and the sun and the tower.
    assert single["A1"]["cosine"] > 0.8


def test_resolution_and_the_time_of_the_sun_are_asked_for(plant: Path):
    flux, report = field(
        plant,
        "main",
        "--at",
        "2026-03-20T20:00",
        "--resolution",
        24,
        60,
        "--surfaces",
        plant.parent,
    )
    assert flux.shape == (24, 60)
    assert report["sun"]["elevation_deg"] == pytest.approx(55.1, abs=0.5)
    assert 800 < report["dni_w_m2"] < 1000  # of a clear sky
    assert report["warnings"][0].startswith("4 of 4 heliostats have no surface in ")


def test_aims_are_followed(plant: Path, tmp_path: Path):
    aims = tmp_path / "aims.csv"
    aims.write_text(
        "name,east_m,north_m,up_m,active\n"
        "A1,0,8,154,1\nA2,0,8,146,1\nA3,0,0,150,0\n"  # B1 is not listed
    )
    flux, report = field(plant, "main", "--sun", 180, 60, "--aims", aims)
    assert list(report["by_heliostat"]) == ["A1", "A2"]
    rows = flux.sum(axis=1)
    middle = len(rows) // 2
    assert rows[middle - 2 : middle + 2].max() < 0.5 * rows.max()
    # The map's middle column faces north, where the heliostats are.
    assert abs(np.argmax(flux.sum(axis=0)) - flux.shape[1] / 2) < flux.shape[1] / 8


def test_heliostats_of_another_receiver_cast_shadows_only(tmp_path: Path):
    layout = "".join(
        f"{line},{receiver}\n"
        for line, receiver in zip(
            LAYOUT.splitlines(), ["receiver", "main", "main", "main", "board"], strict=True
        )
    )
    _, report = field(write_plant(tmp_path, layout=layout), "main", "--sun", 180, 50)
    assert list(report["by_heliostat"]) == ["A1", "A2", "A3"]


@pytest.mark.parametrize(("make", "receiver"), [(gemasolar, "main"), (ps10, "cavity")])
def test_real_layouts_are_traced(make: Any, receiver: str, tmp_path: Path):
    """The nearest hundred heliostats of each."""
    path = make(tmp_path)
    head, *rows = (path.parent / "layout.csv").read_text().splitlines()
    near = sorted(rows, key=lambda row: np.hypot(*map(float, row.split(",")[2:4])))[:100]
    (path.parent / "layout.csv").write_text("\n".join([head, *near]))
    _, report = field(path, receiver, "--sun", 180, 55, "--resolution", 32, 48)
    assert report["field"]["heliostats"] == 100
    assert 0.7 < report["field"]["intercept"] <= 1
    assert report["field"]["shading"] > 0.95


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (
            ("--receiver", "mian", "--sun", 180, 50),
            "--receiver: 'mian' is no receiver of the plant",
        ),
        (("--receiver", "main"), "--sun, --at: give one of them"),
        (("--receiver", "main", "--sun", 180, -2), "--sun: elevation must lie in (0, 90] degrees"),
        (
            ("--receiver", "main", "--at", "2026-03-20T08:00"),
            "--at: the sun's elevation must lie in (0, 90] degrees",
        ),
        (("--receiver", "main", "--at", "1950-03-20T08:00"), "--at: give a year from 1970 on"),
        (("--receiver", "main", "--sun", 180, 50, "--dni", -3), "--dni"),
    ],
)
def test_mistakes_are_named(plant: Path, options: tuple[object, ...], said: str):
    done = heliotwin("field", plant, *options, "--out", plant.parent / "out")
    ends(done, 2, said)
    assert not (plant.parent / "out").exists()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("name,east_m,north_m\nA1,0,8\n", "line 1: column up_m is missing; add it"),
        ("name,east_m,north_m,up_m,aktiv\nA1,0,8,150,0\n", "line 1: column 'aktiv' is not known"),
        ("name,east_m,north_m,up_m\nZZ,0,8,150\n", "line 2: name: 'ZZ' is no heliostat"),
        ("name,east_m,north_m,up_m\nA1,0,8,150\nA1,0,8,150\n", "line 3: name: A1 is listed twice"),
        (
            "name,east_m,north_m,up_m\nA1,0,x,150\n",
            "line 2: north_m: must be a number in [-1e+06, 1e+06], got 'x'",
        ),
        ("name,east_m,north_m,up_m,active\nA1,0,8,150,maybe\n", "line 2: active: must be 1 or 0"),
        ("name,east_m,north_m,up_m,active\nA1,0,8,150,0\n", "no heliostat is active"),
    ],
)
def test_mistakes_in_aims_are_named(plant: Path, tmp_path: Path, text: str, said: str):
    aims = tmp_path / "aims.csv"
    aims.write_text(text)
    options = ("--receiver", "main", "--sun", 180, 50, "--aims", aims, "--out", tmp_path / "out")
    ends(heliotwin("field", plant, *options), 2, said)


@pytest.mark.parametrize(
    "at",
    [
        "2026-06-21T11:36:00.500000+00:00",
        "2026-06-21 11:36",
        "2026-06-21T11:36:00Z",
        "2026-06-21T13:36:00.5+0200",
    ],
)
def test_times_as_isoformat_and_rest_write_them(tmp_path: Path, at: str):
    """The time is read: what is refused next is the plant."""
    missing = tmp_path / "plant.yaml"
    done = heliotwin("field", missing, "--receiver", "main", "--out", tmp_path, "--at", at)
    ends(done, 2, f"{missing}: no such file")


def test_what_is_no_time_is_named(tmp_path: Path):
    done = heliotwin("field", tmp_path / "p.yaml", "--receiver", "main", "--at", "noon")
    ends(done, 2, "'noon' is no time; give it as 2026-06-21T13:00")
