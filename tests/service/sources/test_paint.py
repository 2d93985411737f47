import json
import shutil
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import h5py
import numpy as np
import pytest

from model.effects import effect_to_json
from model.errors import InvalidInputError
from model.metrics import surface_error
from model.sunshape import Buie, Gaussian, Pillbox
from model.sunshape.buie import chi_of_csr
from model.surface import control_points, evaluate
from service.sources.documents import (
    optics_to_json,
    read_heliostat,
    read_item,
    read_json,
    read_measurement,
    read_targets,
    read_tower_base,
)
from service.sources.folder import measured_heights, read_declared, read_folder
from service.sources.hdf5 import read_deflectometry
from tests.conftest import flat_heliostat
from tests.service.conftest import properties_document, tower_document


def test_the_real_plant(stj):
    folder = read_folder(stj)
    assert set(folder.plant.targets) == {
        "multi_focus_tower",
        "solar_tower_juelich_upper",
        "solar_tower_juelich_lower",
    }
    upper = folder.plant.targets["solar_tower_juelich_upper"]
    assert (upper.width, upper.height) == pytest.approx((8.6, 7.2), abs=0.1)
    assert upper.normal @ [0, 1, 0] > 0.999
    # Older and newer spellings of the properties, positions as in the field's own list.
    np.testing.assert_allclose(
        folder.plant.heliostats["AA39"].position, [13.2, 25.0, 1.7], atol=0.3
    )
    np.testing.assert_allclose(folder.plant.heliostats["AD37"].position, [4.4, 38.8, 1.7], atol=1.5)
    assert len(folder.measurements("AA39")) == 9
    assert len(folder.measurements("AA39", with_images=False)) == 12


def test_motor_positions_agree_with_the_spot_to_about_a_degree(stj):
    """README of the data: uncorrected kinematics land within about 1 degree of what the focal spot
    demands.
    """
    folder = read_folder(stj)
    heliostat = folder.plant.heliostats["AA39"]
    measurement = next(m for m in folder.measurements("AA39") if m.external_id == "205363")
    by_motor = heliostat.mount.attitude(
        heliostat.mount.angles_from_motors(measurement.motor_position)
    )
    by_spot = heliostat.mount.attitude(
        heliostat.mount.align(heliostat.position, measurement.to_sun, measurement.spot)
    )
    assert np.degrees(np.arccos(by_motor[:, 2] @ by_spot[:, 2])) < 1.2


def test_a_surface_measured_twice(stj):
    """AA28's measured surface is in its own file and, anonymous, in surfaces.npz: the same order,
    axes and sign.
    """
    folder = read_folder(stj)
    z = measured_heights(folder.plant.heliostats["AA28"], folder.measured_surface("AA28"))
    with np.load(stj / "surfaces.npz") as data:
        others = data["z"].reshape(len(data["z"]), -1)
    correlation = [np.corrcoef(z.ravel(), other)[0, 1] for other in others]
    assert max(correlation) > 0.9


def test_deflectometry_h5_is_fitted(tmp_path):
    heliostat = flat_heliostat(focal_length=60.0)
    z = np.random.default_rng(0).normal(0, 3e-4, (4, 8, 8))
    rng = np.random.default_rng(1)
    with h5py.File(tmp_path / "X-deflectometry.h5", "w") as file:
        for facet, points in enumerate(control_points(heliostat, z), start=1):
            u, v = np.sort(rng.random(50)), np.sort(rng.random(40))
            place, normals = evaluate(points, u, v)
            file[f"facet{facet}/surface_points"] = place.reshape(-1, 3)
            file[f"facet{facet}/surface_normals"] = normals.reshape(-1, 3)
    assert surface_error(read_deflectometry(tmp_path / "X-deflectometry.h5", heliostat), z) < 2e-6


@pytest.mark.parametrize(
    ("sun", "shape"),
    [
        ({"shape": "buie", "circumsolar_ratio": 0.1}, Buie(0.1)),
        ({"shape": "buie", "chi": 0.1}, Buie(0.1)),
        ({"shape": "buie", "csr": 0.05}, Buie(chi_of_csr(0.05))),
        ({"shape": "pillbox", "half_angle_mrad": 4.7}, Pillbox(4.7e-3)),
        ({"shape": "gaussian", "sigma_mrad": 2.5}, Gaussian(2.5e-3)),
    ],
)
def test_declared_sun(tmp_path, sun, shape):
    (tmp_path / "twin.json").write_text(json.dumps({"declared": {"sun": sun, "effects": []}}))
    optics, effects, _ = read_declared(tmp_path / "twin.json")
    assert optics.sun_shape == shape
    assert effects == ()


def test_undeclared_sun_is_buies(tmp_path):
    assert read_declared(tmp_path / "twin.json")[0].sun_shape == Buie(0.02)


def test_declared_optics_and_their_defaults(tmp_path):
    plain, *_ = read_declared(tmp_path / "twin.json")
    assert optics_to_json(plain) == {"reflectivity": 1.0, "attenuation": []}
    declared = {"reflectivity": 0.9, "attenuation": [0.01, 0.1]}
    (tmp_path / "twin.json").write_text(json.dumps({"declared": {"optics": declared}}))
    optics, *_ = read_declared(tmp_path / "twin.json")
    assert optics_to_json(optics) == declared
    assert optics.sun_shape == Buie(0.02)


def test_declared_effects(tmp_path):
    effects = [
        {"name": "soiling", "parameters": {"reflectivity_ratio": {"AA39": [1.0, 0.8, 1.0, 0.9]}}}
    ]
    (tmp_path / "twin.json").write_text(json.dumps({"declared": {"effects": effects}}))
    _, declared, _ = read_declared(tmp_path / "twin.json")
    assert [effect_to_json(effect) for effect in declared] == effects


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("{", "is no JSON"),
        ("{}", "'declared' is missing"),
        ('{"declared": {"sun": {"shape": "square"}}}', "'shape' must be"),
        ('{"declared": {"sun": {"shape": "buie", "circumsolar_ratio": NaN}}}', "finite number"),
        (
            '{"declared": {"sun": {"shape": "buie", "chi": 0.02, "csr": 0.02}}}',
            "chi and csr are the same; give one",
        ),
        ('{"declared": {"effects": [{"name": "dust"}]}}', "twin.json: effect 'dust' is unknown"),
        (
            '{"declared": {"effects": [{"name": "slope_error", "parameters": {"sigma_mrad": 9}}]}}',
            "sigma_mrad",
        ),
        ('{"declared": []}', "'declared' must be a JSON object"),
        ('{"declared": {"optics": []}}', "optics: document: must be a JSON object"),
        (
            '{"declared": {"optics": {"reflectivity": 1.2}}}',
            "optics: reflectivity: must be 1 or less",
        ),
        (
            '{"declared": {"optics": {"reflectivity": true}}}',
            "optics: reflectivity: must be a number",
        ),
        ('{"declared": {"optics": {"attenuation": 0.1}}}', "optics: attenuation: must be a list"),
        (
            '{"declared": {"optics": {"attenuation": [0, "a"]}}}',
            "optics: attenuation.1: must be a number",
        ),
        ('{"declared": {"optics": {"shine": 1}}}', "optics: shine: is not known here"),
    ],
)
def test_bad_declarations_name_the_field(tmp_path, content, says):
    (tmp_path / "twin.json").write_text(content)
    with pytest.raises(InvalidInputError, match=says):
        read_declared(tmp_path / "twin.json")


def test_bad_measurements_name_the_field(stj):
    plant = read_folder(stj).plant
    good = {"target_name": "multi_focus_tower", "sun_elevation": 30.0, "sun_azimuth": 1.0}
    assert read_measurement("1", "AA39", good, plant).spot is None
    for change, says in [
        ({"target_name": "moon"}, "target_name"),
        ({"sun_elevation": -3}, "sun_elevation"),
        ({"sun_azimuth": "east"}, "sun_azimuth"),
        ({"focal_spot": {"UTIS": [1, 2]}}, "UTIS"),
        ({"motor_position": {"axis_1_motor_position": 1}}, "axis_2_motor_position"),
    ]:
        with pytest.raises(InvalidInputError, match=says):
            read_measurement("1", "AA39", {**good, **change}, plant)


def test_bad_properties_name_the_field():
    origin = np.array([50.9, 6.4, 87.0])
    for properties, says in [([], "JSON object"), ({}, "heliostat_position")]:
        with pytest.raises(InvalidInputError, match=says):
            read_heliostat("AA39", properties, origin)
    with pytest.raises(InvalidInputError, match="coordinates"):
        read_targets({"power_plant_properties": {}})


@pytest.mark.parametrize(
    "moment", ["2021-07-14T11:05:27Z", "2021-07-14T13:05:27+02:00", "2021-07-14T11:05:27"]
)
def test_a_stac_item_tells_when_a_measurement_was_taken(moment):
    taken_at = read_item({"properties": {"datetime": moment}}, "item").taken_at
    assert taken_at == datetime(2021, 7, 14, 11, 5, 27, tzinfo=UTC)


@pytest.mark.parametrize("moment", [None, 5, "yesterday"])
def test_a_stac_item_without_a_time_is_named(moment):
    with pytest.raises(InvalidInputError, match=r"item: .*datetime: must be an ISO 8601 time"):
        read_item({"properties": {"datetime": moment}}, "item")


def test_two_files_of_properties_are_refused_by_name_and_the_plant_has_its_own(tmp_path: Path):
    """Neither of the two is taken in part, and a file's name is no plant's."""
    for name in ("AA39", "AB12"):
        folder = tmp_path / name / "Properties"
        folder.mkdir(parents=True)
        (folder / f"{name}-heliostat-properties.json").write_text(json.dumps(properties_document()))
    (tmp_path / "AB12" / "Properties" / "old-heliostat-properties.json").write_text(
        json.dumps(properties_document())
    )
    (tmp_path / "renamed-tower-measurements.json").write_text(json.dumps(tower_document()))
    folder = read_folder(tmp_path)
    assert folder.plant.name == "WRI1030197"
    assert list(folder.plant.heliostats) == ["AA39"]
    assert "AB12-heliostat-properties.json, old-heliostat-properties.json" in folder.skipped["AB12"]
    shutil.copy(
        tmp_path / "renamed-tower-measurements.json", tmp_path / "b-tower-measurements.json"
    )
    with pytest.raises(InvalidInputError, match=r"b-tower.*, renamed-tower.*leave the right one"):
        read_folder(tmp_path)


def test_facets_in_another_order_are_refused():
    document = properties_document()
    origin = read_tower_base(tower_document())
    facets = document["facet_properties"]["facets"]
    assert len(read_heliostat("AA39", document, origin).facets) == 4
    for order in ([1, 0, 2, 3], [2, 3, 0, 1], [0, 2, 1, 3]):
        document["facet_properties"]["facets"] = [facets[index] for index in order]
        with pytest.raises(
            InvalidInputError, match="AA39: 'facets' must be listed upper left, upper right"
        ):
            read_heliostat("AA39", document, origin)
    for some in (facets[:1], facets[:3]):
        document["facet_properties"]["facets"] = some
        assert len(read_heliostat("AA39", document, origin).facets) == len(some)
    one = flat_heliostat()
    three = replace(one, facets=one.facets[:3])
    with pytest.raises(InvalidInputError, match="a surface of 4 facets for flat, which has 3"):
        measured_heights(three, (control_points(one), 3))
    document["facet_properties"]["facets"] = 4
    with pytest.raises(InvalidInputError, match=r"facets: must be a list"):
        read_heliostat("AA39", document, origin)


def test_json_may_begin_with_a_byte_order_mark_and_has_each_key_once(tmp_path: Path):
    file = tmp_path / "twin.json"
    file.write_bytes(b'\xef\xbb\xbf{"a": 1}')
    assert read_json(file) == {"a": 1}
    file.write_text('{"a": 1, "b": {"c": 1, "c": 2}}')
    with pytest.raises(InvalidInputError, match="'c' is there twice; keep one"):
        read_json(file)
