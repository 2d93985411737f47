"""A small plant whose heliostats aim at receivers of several kinds."""

from pathlib import Path

from service.sources.plant_template import staggered_layout

PLANT = """\
plant: {name: small, latitude_deg: 37, longitude_deg: -5, altitude_m: 100, time_zone: Europe/Madrid}
heliostat_types:
  large:
    mount: {kind: azimuth_elevation, pivot_height_m: 5}
    facets: {rows: 1, columns: 1, width_m: 9, height_m: 8}
    facet_shape: slant_range
    reflectance: 0.93
    slope_error_mrad: 1.3
    pointing_error_mrad: 0.8
layout: {file: layout.csv}
receivers:
  main: {kind: cylinder, center_m: [0, 0, 80], radius_m: 4, height_m: 10}
  board: {kind: plane, center_m: [0, 3, 80], normal: [0, 1, 0], width_m: 10, height_m: 10}
  strip: {kind: plane, center_m: [0, 3, 90], normal: [0, 1, 0], width_m: 3, height_m: 3}
  cave:
    kind: cavity
    aperture_m: [[4, 3, 76], [-4, 3, 76], [-4, 3, 84], [4, 3, 84]]
    panels:
      - {center_m: [2.4, 0, 80], normal: [-0.3, 1, 0], width_m: 5, height_m: 9}
      - {center_m: [-2.4, 0, 80], normal: [0.3, 1, 0], width_m: 5, height_m: 9}
sun: {shape: pillbox, half_angle_mrad: 4.65}
"""


def write_aim_plant(folder: Path) -> Path:
    """Some fifty heliostats north of four receivers; the path of plant.yaml."""
    folder.mkdir(parents=True, exist_ok=True)
    layout = staggered_layout("large", [140, 170, 200, 230], 32, 0.0, 75.0)
    (folder / "layout.csv").write_text(layout)
    (folder / "plant.yaml").write_text(PLANT)
    return folder / "plant.yaml"
