"""Control heights from deflectometry whose truth is known."""

import json
from dataclasses import replace

import h5py
import numpy as np
import pytest

from model.plant import Heliostat
from model.prior import ripples
from model.surface import control_points, evaluate, halved
from training.fit import Deflectometry, fit, fit_accuracies, read_deflectometry, row

GRID = (np.arange(40) + 0.5) / 40


@pytest.fixture(scope="module")
def heliostat() -> Heliostat:
    return Heliostat.juelich("AA01", (10.0, 60.0, 1.8), 75.0)


@pytest.fixture(scope="module")
def truth() -> np.ndarray:
    z = np.random.default_rng(4).normal(0, 2e-4, (4, 8, 8))
    return z - z.mean(axis=(1, 2), keepdims=True)


@pytest.fixture(scope="module")
def measured(heliostat, truth) -> Deflectometry:
    points, normals = evaluate(control_points(heliostat, truth), GRID, GRID)
    return Deflectometry(heliostat, list(points.reshape(4, -1, 3)), list(normals.reshape(4, -1, 3)))


def test_a_surface_of_its_own_kind_is_found_again(measured, truth):
    fitted = fit(measured)
    np.testing.assert_allclose(fitted.z, truth, atol=1e-7)
    assert fitted.residuals_mrad.max() < 1e-3


def test_residuals_are_the_noise_of_the_normals(measured):
    """Angles of two normal components of 0.2 mrad are Rayleigh-distributed; 64 heights take little
    of them away.
    """
    rng = np.random.default_rng(0)
    noisy = replace(measured, normals=[n + rng.normal(0, 2e-4, n.shape) for n in measured.normals])
    residuals = fit(noisy).residuals_mrad
    assert np.sqrt((residuals**2).mean()) == pytest.approx(0.2 * 2**0.5, rel=0.04)
    assert (residuals < 0.1).mean() == pytest.approx(1 - np.exp(-0.5 * 0.5**2), abs=0.02)
    assert np.quantile(residuals, 0.99) == pytest.approx(0.2 * np.sqrt(2 * np.log(100)), rel=0.05)


def test_places_off_the_facet_and_normals_that_failed_are_not_used(measured, truth):
    points, normals = [p.copy() for p in measured.points], [n.copy() for n in measured.normals]
    points[0][:7] += [3.0, 0.0, 0.0]
    normals[1][:5] = np.nan
    fitted = fit(replace(measured, points=points, normals=normals))
    np.testing.assert_allclose(fitted.z, truth, atol=1e-7)
    assert len(fitted.residuals_mrad) == 4 * 1600 - 12


def test_flux_is_lost_by_what_the_heights_leave_out(heliostat, truth, measured):
    fine = control_points(heliostat, truth)
    assert fit_accuracies(heliostat, fine, fine).min() == pytest.approx(1)
    coarse = control_points(heliostat, truth + 1e-4 * np.cos(np.pi * np.arange(8)))
    assert 0.5 < fit_accuracies(heliostat, fine, coarse).mean() < 0.98
    assert row(replace(measured, fine=fine), fit(measured))[-2] == "0.000"


def test_ripples_are_what_the_heights_leave_out(heliostat, truth, measured):
    directions = ripples(heliostat.facet_frames[2])
    rippled = halved(truth) + np.tensordot(
        np.random.default_rng(4).normal(size=len(directions)), directions, axes=1
    )
    line = row(replace(measured, fine=control_points(heliostat, rippled)), fit(measured))
    assert float(line[-1]) == pytest.approx(1e3 * (rippled - halved(truth)).std(), abs=0.004)
    assert row(measured, fit(measured))[-2:] == ["", ""]


def test_both_kinds_of_files_are_read(tmp_path, measured, truth):
    properties = {
        "heliostat_position": [50.9140, 6.3878, 88.8],
        "facet_properties": {
            "facets": [
                {
                    "translation_vector": list(f.position),
                    "canting_e": list(f.canting_x),
                    "canting_n": list(f.canting_y),
                }
                for f in measured.heliostat.facets
            ]
        },
    }
    tower = {"power_plant_properties": {"coordinates": [50.9134, 6.3878, 87.0]}}
    (tmp_path / "X-tower-measurements.json").write_text(json.dumps(tower))
    for name in ("AA01", "AA02", "AA03"):
        for part in ("Properties", "Deflectometry"):
            (tmp_path / name / part).mkdir(parents=True)
        (tmp_path / name / "Properties" / f"{name}-heliostat-properties.json").write_text(
            json.dumps(properties)
        )
    with h5py.File(
        tmp_path / "AA01" / "Deflectometry" / "AA01-filled-deflectometry.h5", "w"
    ) as file:
        for index in range(4):
            file[f"facet{index + 1}/surface_points"] = measured.points[index]
            file[f"facet{index + 1}/surface_normals"] = measured.normals[index]
    np.savez(
        tmp_path / "AA02" / "Deflectometry" / "AA02-nurbs-surface.npz",
        points=np.reshape(measured.points, (4, 40, 40, 3)),
        normals=np.reshape(measured.normals, (4, 40, 40, 3)),
        control_points=control_points(measured.heliostat, truth),
    )
    first, second = (read_deflectometry(tmp_path, name) for name in ("AA01", "AA02"))
    for found in (first, second):
        assert found is not None
        np.testing.assert_allclose(fit(found).z, truth, atol=1e-7)
    assert first.fine is None
    assert second.fine is not None
    assert first.heliostat.position[1] == pytest.approx(66.7, abs=1)
    assert read_deflectometry(tmp_path, "AA03") is None
