"""Plants as files: one that has a bit of everything, and others from published layouts."""

import csv
import os
from pathlib import Path
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).parents[3]

PLANT = """\
plant: {name: daggett, latitude_deg: 34.86, longitude_deg: -116.83, altitude_m: 600, time_zone: America/Los_Angeles}
heliostat_types:
  large:
    mount: {kind: azimuth_elevation, pivot_height_m: 6.0, mirror_offset_m: 0.2}
    facets: {rows: 4, columns: 7, width_m: 1.8, height_m: 1.35, gap_m: 0.02}
    facet_shape: flat
    canting: on_axis
    reflectance: 0.95
    slope_error_mrad: 1.0
    pointing_error_mrad: 0.5
  small:
    mount: {kind: pitch_roll}
    facets: {file: facets.csv}
layout: {file: layout.csv}
receivers:
  main: {kind: cylinder, center_m: [0, 0, 150], radius_m: 8, height_m: 16, absorptance: 0.94}
  board: {kind: plane, center_m: [0, 0, 62], normal: [0, 1, 0], up: [0, 0, 1], width_m: 8, height_m: 6, absorptance: 0.9}
targets:
  cal: {kind: plane, center_m: [0, 5, 40], normal: [0, 1, 0], up: [0, 0, 1], width_m: 12, height_m: 12}
tower: {radius_m: 8, height_m: 140}
sun: {shape: pillbox, half_angle_mrad: 4.65}
atmosphere: {attenuation: [0.006789, 0.1046, -0.0107, 0.002845]}
"""
"""The plant of the file format's contract, with a second type."""

RICH = PLANT.replace(
    "mount: {kind: pitch_roll}",
    "mount: {kind: target_aligned, drives: [{kind: rotary, gear: 18000}, {kind: linear,"
    " increment_steps_per_m: 154166666, initial_stroke_length_m: 0.075, offset_m: 0.34,"
    " pivot_radius_m: 0.3191, initial_angle_rad: -0.01, clockwise: false,"
    " max_increment_steps: 69296}]}",
)
for _old, _new in (
    ("canting: on_axis", "canting: {off_axis: {azimuth_deg: 180, elevation_deg: 40}}"),
    ("facet_shape: flat", "facet_shape: {focal_length_m: 300}"),
    ("{shape: pillbox, half_angle_mrad: 4.65}", "{shape: buie, csr: 0.05}"),
    ("{attenuation: [0.006789, 0.1046, -0.0107, 0.002845]}", "{visibility_km: 23}"),
    (
        "width_m: 12,",
        "width_m: 12, camera: {homography: [[0.01, 0, -7], [0, -0.01, 7], [0, 0, 1]]},",
    ),
    (
        "  board:",
        "  cave: {kind: cavity, aperture_m: [[7, -1, 94], [-7, -1, 94], [-7, 1, 106], [7, 1, 106]],"
        " panels: [{center_m: [0, -5, 100], normal: [0, 1, 0], width_m: 5.4, height_m: 12}]}\n"
        "  walls: {kind: panels, panels: [{center_m: [0, -5, 100], normal: [0, 1, 0],"
        " width_m: 5.4, height_m: 12}]}\n"
        "  board:",
    ),
):
    assert _old in RICH
    RICH = RICH.replace(_old, _new, 1)
"""The same plant with what else the format has."""

LAYOUT = """\
name,type,east_m,north_m,up_m,receiver,focal_length_m
A1,large,0,200,0,,
A2,large,-50,220,0,main,250
B1,small,30,120,-1.5,board,
"""

FACETS = """\
x_m,y_m,z_m,normal_x,normal_y,normal_z,width_m,height_m,polygon,radius_m
-1,0,0,0.005,0,1,1.9,2,,
1,0,0,-0.005,0,1,,,-0.9 -1; 0.9 -1; 0.9 0.5; 0 1,
0,3,0,0,-0.01,1,,,,0.8
"""


def write_plant(
    folder: Path, plant: str = PLANT, layout: str = LAYOUT, facets: str = FACETS
) -> Path:
    """The files of a plant; the path of plant.yaml."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "plant.yaml"
    path.write_text(plant, encoding="utf-8")
    (folder / "layout.csv").write_text(layout, encoding="utf-8")
    (folder / "facets.csv").write_text(facets, encoding="utf-8")
    return path


def published() -> Path:
    """Layouts of real plants; skips where they are absent."""
    root = Path(os.environ.get("HELIOTWIN_PLANTS", ROOT.parents[0] / "shared" / "plants"))
    if not root.is_dir() and "HELIOTWIN_PLANTS" not in os.environ:
        root = ROOT.parents[1] / "shared" / "plants"
    if not root.is_dir():
        pytest.skip(f"no plants at {root}; set HELIOTWIN_PLANTS")
    return root


def _write(folder: Path, document: dict[str, Any], rows: list[list[Any]], *more: str) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "plant.yaml"
    path.write_text(yaml.safe_dump({**document, "layout": {"file": "layout.csv"}}, sort_keys=False))
    with (folder / "layout.csv").open("w", newline="") as file:
        csv.writer(file).writerows([["name", "type", "east_m", "north_m", "up_m", *more], *rows])
    return path


def _rows(path: Path) -> list[list[str]]:
    with path.open(newline="", encoding="utf-8-sig") as file:
        return [row for row in csv.reader(file) if row][1:]


def _one_facet(width: float, height: float, **more: Any) -> dict[str, Any]:
    return {
        "mount": {"kind": "azimuth_elevation"},
        "facets": {"rows": 1, "columns": 1, "width_m": width, "height_m": height},
        "facet_shape": "slant_range",
        **more,
    }


def gemasolar(folder: Path) -> Path:
    """2,650 heliostats around a cylinder, as the parameters beside the layout say."""
    document = {
        "plant": {
            "name": "gemasolar",
            "latitude_deg": 37.56,
            "longitude_deg": -5.32,
            "altitude_m": 168,
            "time_zone": "Europe/Madrid",
        },
        "heliostat_types": {
            "large": _one_facet(9.752, 12.305, reflectance=0.93, slope_error_mrad=1.45)
        },
        "receivers": {
            "main": {"kind": "cylinder", "center_m": [0, 0, 116], "radius_m": 4, "height_m": 16}
        },
        "sun": {"shape": "buie", "csr": 0.05},
    }
    rows = _rows(published() / "layouts" / "Gemasolar_layout.csv")
    return _write(folder, document, [[name, "large", x, y, 0] for name, x, y in rows])


def ps10(folder: Path) -> Path:
    """624 heliostats north of a cavity of four panels, which looks down by 12.5 degrees."""
    panel = {"width_m": 5.4, "height_m": 12.0}
    places = [(5.0, -2.5, (-1, 0.4)), (2.0, -4.6, (-0.35, 0.9)), (-2.0, -4.6, (0.35, 0.9))]
    places += [(-5.0, -2.5, (1, 0.4))]
    document = {
        "plant": {
            "name": "ps10",
            "latitude_deg": 37.43,
            "longitude_deg": -6.25,
            "altitude_m": 63,
            "time_zone": "Europe/Madrid",
        },
        "heliostat_types": {
            "sanlucar": _one_facet(
                12.84, 9.45, reflectance=0.88, slope_error_mrad=2.6, pointing_error_mrad=1.3
            )
        },
        "receivers": {
            "cavity": {
                "kind": "cavity",
                "aperture_m": [
                    [6.9, -1.3, 94.6],
                    [-6.9, -1.3, 94.6],
                    [-6.9, 1.3, 106.4],
                    [6.9, 1.3, 106.4],
                ],
                "panels": [
                    {"center_m": [x, y, 100.5], "normal": [*n, 0], **panel} for x, y, n in places
                ],
            }
        },
        "sun": {"shape": "buie", "csr": 0.05},
    }
    rows = _rows(published() / "layouts" / "PS10_layout.csv")
    return _write(folder, document, [[name, "sanlucar", x, y, 0] for name, x, y in rows])


def solar_two(folder: Path) -> Path:
    """1,926 heliostats of two types."""
    document = {
        "plant": {"name": "solar-two", "latitude_deg": 34.87, "longitude_deg": -116.83},
        "heliostat_types": {"MM": _one_facet(6.419, 6.596), "LUGO": _one_facet(10.363, 10.363)},
        "receivers": {
            "main": {"kind": "cylinder", "center_m": [0, 0, 76], "radius_m": 2.55, "height_m": 6.2}
        },
    }
    rows = _rows(published() / "layouts" / "SolarTwo_layout.csv")
    return _write(folder, document, [[name, kind, x, y, z] for name, x, y, z, kind in rows])


def round_c(folder: Path) -> Path:
    """522 heliostats of the six tools' round C, each with its focal length."""
    document = {
        "plant": {"name": "round-c", "latitude_deg": 37.4, "longitude_deg": -6.25},
        "heliostat_types": {
            "ideal": _one_facet(10.0, 10.0, reflectance=0.95, slope_error_mrad=2.0)
        },
        "receivers": {
            "board": {
                "kind": "plane",
                "center_m": [0, 0, 62],
                "normal": [0, 1, 0],
                "width_m": 8,
                "height_m": 6,
                "absorptance": 0.9,
            }
        },
        "sun": {"shape": "pillbox", "half_angle_mrad": 4.65},
    }
    rows = _rows(published() / "six-tools" / "Round3_layout.csv")
    placed = [[f"H{n}", "ideal", x, y, z, f] for n, (x, y, z, f) in enumerate(rows, start=1)]
    return _write(folder, document, placed, "focal_length_m")


THREE_MOUNTS = """\
plant: {name: daggett, latitude_deg: 34.86, longitude_deg: -116.83, altitude_m: 600}
heliostat_types:
  upright:
    mount: {kind: azimuth_elevation, pivot_height_m: 4.0, mirror_offset_m: 0.2}
    facets: {rows: 2, columns: 3, width_m: 1.8, height_m: 1.35, gap_m: 0.02}
    facet_shape: slant_range
  rolled:
    mount: {kind: pitch_roll, pivot_height_m: 3.0, mirror_offset_m: 0.1}
    facets: {rows: 2, columns: 3, width_m: 1.8, height_m: 1.35, gap_m: 0.02}
    canting: {focal_length_m: 150}
  driven:
    mount: {kind: juelich, pivot_height_m: 2.0, mirror_offset_m: 0.175, drives: [
      {kind: linear, increment_steps_per_m: 154166.67, initial_stroke_length_m: 0.0759, offset_m: 0.3353, pivot_radius_m: 0.3381, initial_angle_rad: -1.5466, clockwise: false, max_increment_steps: 69296},
      {kind: linear, increment_steps_per_m: 154166.67, initial_stroke_length_m: 0.0769, offset_m: 0.3408, pivot_radius_m: 0.3191, initial_angle_rad: 0.9465, clockwise: true, max_increment_steps: 75000}]}
    facets: {rows: 2, columns: 3, width_m: 1.8, height_m: 1.35, gap_m: 0.02}
    canting: flat
layout: {file: layout.csv}
receivers:
  main: {kind: cylinder, center_m: [0, 0, 80], radius_m: 4, height_m: 10, facing_azimuth_deg: 20, opening_deg: 180}
targets:
  cal: {kind: plane, center_m: [0, -3, 60], normal: [0, 1, 0], width_m: 14, height_m: 14}
sun: {shape: gaussian, sigma_mrad: 2.35}
"""
"""A plant that ARTIST can say."""


def write_three_mounts(folder: Path) -> Path:
    """Five heliostats on mounts of three kinds; the path of plant.yaml."""
    layout = "A1,upright,30,150,0\nA2,upright,-80,120,1\nB1,rolled,-20,130,0\nB2,rolled,60,180,2\n"
    heads = "name,type,east_m,north_m,up_m\n"
    return write_plant(folder, THREE_MOUNTS, heads + layout + "C1,driven,10,100,0\n")
