"""``heliotwin aim``: the most power under the flux that a receiver can take."""

import csv
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from heliotwin.aim import trace_kernels
from heliotwin.field import FieldRequest
from model.aiming import kernels, plan
from model.aiming.bound import bound_power
from model.aiming.kernels import require_few_pairs
from model.aiming.plan import linear_draws, mirror_values, single_aim
from model.errors import InvalidInputError
from model.surface import control_points
from service.base.progress import no_progress
from service.sources.folder import read_height_std
from service.sources.limits import read_limit
from service.sources.plant_file import read_plant
from tests.service.command import ends, heliotwin
from tests.service.sources.aim_plant import write_aim_plant

SUN = ("--sun", 180, 55, "--dni", 900)


@pytest.fixture(scope="module")
def plant(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Fifty heliostats north of three receivers."""
    return write_aim_plant(tmp_path_factory.mktemp("aims"))


def aimed(plant: Path, out: Path, receiver: str, limit: object, *options: object) -> dict[str, Any]:
    """The report of aims in ``out``."""
    done = heliotwin(
        "aim", plant, "--receiver", receiver, "--limit", limit, "--out", out / "aims.csv",
        "--report", out / "report.json", *SUN, *options,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    report: dict[str, Any] = json.loads((out / "report.json").read_text())
    return report


def test_a_report_is_not_needed_and_the_table_has_three_figures(plant: Path, tmp_path: Path):
    out = tmp_path / "aims.csv"
    done = heliotwin("aim", plant, "--receiver", "board", "--limit", 900, "--out", out, *SUN)
    assert done.returncode == 0, done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["aims.csv"]
    assert re.search(r"power +│ +\d\.\d\d MW", done.stdout)
    assert re.search(r"limit +│ +900 kW/m2", done.stdout)


def field(plant: Path, out: Path, receiver: str, *options: object) -> dict[str, Any]:
    """The field's figures by `heliotwin field`, on a map of as many pixels as aims are found on."""
    done = heliotwin("field", plant, "--receiver", receiver, "--out", out / "field", *SUN, *options)
    assert done.returncode == 0, done.stderr
    figures: dict[str, Any] = json.loads((out / "field" / "field.json").read_text())["field"]
    return figures


@pytest.mark.parametrize(
    ("receiver", "resolution"),
    [("main", (32, 80)), pytest.param("board", (32, 32), marks=pytest.mark.full)],
)
def test_aims_give_what_their_report_says(
    plant: Path, tmp_path: Path, receiver: str, resolution: tuple[int, int]
):
    single = field(plant, tmp_path, receiver, "--resolution", *resolution)
    limit = 0.4 * single["peak_w_m2"] / 1e3
    report = aimed(plant, tmp_path, receiver, f"{limit:.3f}")
    assert report["single_aim_power_w"] == pytest.approx(single["intercepted_w"], rel=1e-3)
    assert report["limit_w_m2"] == pytest.approx(1e3 * limit, rel=1e-5)
    assert report["peak_w_m2"] < report["peak_p95_w_m2"] <= 1.002e3 * limit
    assert report["power_w"] > 0.98 * report["single_aim_power_w"]
    assert report["power_w"] > 0.995 * report["baseline"]["power_w"]
    assert report["power_w"] < report["bound_w"] < 1.02 * report["power_w"]
    assert report["inactive"] == []
    low, high = report["peak_interval_w_m2"]
    assert low < report["peak_p95_w_m2"] <= high
    low, high = report["power_interval_w"]
    assert 0.999 * low < report["power_w"] < 1.001 * high < 1.02 * low
    assert report["surface_draws"] == 0
    assert set(report["seconds"]) == {"kernels", "aims"}
    traced = field(
        plant, tmp_path, receiver, "--resolution", *resolution, "--aims", tmp_path / "aims.csv"
    )
    assert traced["intercepted_w"] == pytest.approx(report["power_w"], rel=0.005)
    assert traced["peak_w_m2"] == pytest.approx(report["peak_w_m2"], rel=0.02)


@pytest.fixture
def states(plant: Path, tmp_path: Path) -> Path:
    """A soiled mirror and one that points badly, the fourth and the eighth."""
    names = list(read_plant(plant).plant.heliostats)
    path = tmp_path / "states.csv"
    path.write_text(
        "name,cleanliness,cleanliness_low,cleanliness_high,pointing_error_mrad\n"
        f"{names[3]},0.55,0.5,0.6,\n{names[7]},,,,12\n"
    )
    return path


def test_measured_states_act_in_fields(plant: Path, states: Path, tmp_path: Path):
    """A soiled mirror has its share of the light, and one that points badly spills."""
    names = list(read_plant(plant).plant.heliostats)
    soiled, off = names[3], names[7]
    given = ("--states", states)
    before = field(plant, tmp_path, "main", "--resolution", 32, 80)
    after = field(plant, tmp_path, "main", "--resolution", 32, 80, *given)
    assert before["cleanliness"] == pytest.approx(1)
    assert after["cleanliness"] == pytest.approx(1 - 0.45 / len(names), abs=2e-3)
    report = json.loads((tmp_path / "field" / "field.json").read_text())
    light = report["by_heliostat"]
    assert light[soiled]["cleanliness"] == pytest.approx(0.55)
    assert light[off]["intercept"] < 0.95 < before["intercept"]
    assert report["sources"]["cleanliness"] == {"declared": len(names) - 1, "measured": 1}
    assert report["states"][soiled]["cleanliness"]["ci95"] == [0.5, 0.6]
    assert set(report["states"]) == {soiled, off}


@pytest.mark.full
def test_measured_states_act_in_aims(plant: Path, states: Path, tmp_path: Path):
    n_declared = len(read_plant(plant).plant.heliostats) - 1
    plain, known = (
        aimed(plant, tmp_path, "main", 400, "--resolution", 24, 60, *some)
        for some in ((), ("--states", states))
    )
    assert known["sources"]["pointing_error_mrad"] == {"declared": n_declared, "measured": 1}
    assert known["single_aim_power_w"] < 0.993 * plain["single_aim_power_w"]
    assert known["power_w"] < 0.995 * plain["power_w"]


@pytest.mark.full
def test_light_enters_a_cavity_and_its_panels_stay_under_the_limit(plant: Path, tmp_path: Path):
    single = field(plant, tmp_path, "cave", "--resolution", 24, 30)
    limit = 0.8 * single["peak_w_m2"] / 1e3
    report = aimed(plant, tmp_path, "cave", limit, "--resolution", 24, 30)
    assert report["peak_p95_w_m2"] <= 1.002e3 * limit
    assert report["power_w"] > 0.97 * report["single_aim_power_w"]
    assert report["power_w"] < report["bound_w"]
    # Those behind the opening are left out, and the report says so.
    assert all("behind" in why or "faces away" in why for why in report["skipped"].values())


@pytest.mark.full
def test_plans_begin_with_aims_of_a_moment_before(plant: Path, tmp_path: Path):
    first = aimed(plant, tmp_path, "board", 900)
    again = aimed(plant, tmp_path, "board", 900, "--start", tmp_path / "aims.csv")
    assert again["power_w"] > 0.995 * first["power_w"]
    assert again["peak_p95_w_m2"] <= 1.002 * 900e3


@pytest.mark.full
def test_mirrors_are_defocused_where_no_aims_help(plant: Path, tmp_path: Path):
    report = aimed(plant, tmp_path, "strip", 200)  # 1.8 MW at most, of 2.6 MW
    assert report["inactive"]
    assert report["peak_p95_w_m2"] <= 1.002 * 200e3
    assert report["power_w"] > report["baseline"]["power_w"]
    with (tmp_path / "aims.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["name"] for row in rows if row["active"] == "0"] == report["inactive"]
    assert report["power_w"] < report["bound_w"]


def test_limits_over_the_map_and_along_the_flow_path(tmp_path: Path):
    table = tmp_path / "limit.csv"
    table.write_text("800,900\n700,600\n")
    np.testing.assert_allclose(
        read_limit(str(table)).on_map(4, 4)[[0, 0, 3, 3], [0, 3, 0, 3]], [8e5, 9e5, 7e5, 6e5]
    )
    path = tmp_path / "path.csv"
    path.write_text("position,share\n0,1\n0.5,0.8\n1,0.4\n")
    along = read_limit("1000", path).on_map(1, 5)[0]
    np.testing.assert_allclose(along, [0.56e6, 0.84e6, 1e6, 0.84e6, 0.56e6])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("800,900\n700\n", "limit.csv, line 2: has 1 limits, and the first 2"),
        ("800,0\n", "limit.csv, line 1: cell 2 must be a number"),
        ("800,high\n", "limit.csv, line 1: cell 2 must be a number"),
        ("", "has no limits"),
    ],
)
def test_a_wrong_limit_is_refused_by_its_line(plant: Path, tmp_path: Path, text: str, said: str):
    (tmp_path / "limit.csv").write_text(text)
    done = heliotwin(
        "aim", plant, "--receiver", "main", "--limit", tmp_path / "limit.csv", "--out",
        tmp_path / "aims.csv", "--report", tmp_path / "report.json", *SUN,
    )  # fmt: skip
    ends(done, 2, said)
    assert not (tmp_path / "aims.csv").exists()


@pytest.mark.parametrize("limit", ["0", "-3", "nan", "no-such-file.csv", "1e9"])
def test_a_limit_is_a_positive_number_or_a_file(plant: Path, tmp_path: Path, limit: str):
    done = heliotwin(
        "aim", plant, "--receiver", "main", "--limit", limit, "--out", tmp_path / "aims.csv",
        "--report", tmp_path / "report.json", *SUN,
    )  # fmt: skip
    ends(done, 2, "--limit")


def test_a_quarter_of_the_pixels_has_the_same_light(plant: Path):
    request = FieldRequest("board", 180.0, 55.0, 900.0, resolution=(31, 33))
    found = trace_kernels(read_plant(plant), request, no_progress).kernels
    thin = found.thinned()
    moved = torch.zeros(len(found), 2)
    whole, some = found.flux(moved), thin.kernels.flux(moved)
    assert float(thin.kernels.areas.sum()) == pytest.approx(float(found.areas.sum()), rel=1e-5)
    assert len(some) == 16 * 17
    assert np.isin(some.numpy(), whole.numpy()).all()
    power = float(whole @ found.areas)
    assert float(some @ thin.kernels.areas) == pytest.approx(power, rel=0.01)


def test_images_of_half_as_many_pixels_have_the_same_light(
    plant: Path, monkeypatch: pytest.MonkeyPatch
):
    """Those of more than `MANY` heliostats; sharpened by what interpolation blurs."""
    request = FieldRequest("board", 180.0, 55.0, 900.0, resolution=(32, 32))
    maps, bounds = [], []
    for many in (kernels.MANY, 0):
        monkeypatch.setattr(kernels, "MANY", many)
        found = trace_kernels(read_plant(plant), request, no_progress).kernels
        assert found.size == (64 if many else 32)
        plan = single_aim(found, torch.full_like(found.areas, 30e3))
        maps.append(plan.flux)
        bounds.append(bound_power(plan, 1))
    assert float((maps[1] - maps[0]).abs().sum()) < 0.02 * float(maps[0].sum())
    assert float(maps[1].max()) == pytest.approx(float(maps[0].max()), rel=0.03)
    assert bounds[1] == pytest.approx(bounds[0], rel=0.01)


def test_one_row_of_pixels_serves_all_mirrors_of_a_map_that_they_light_whole(plant: Path):
    request = FieldRequest("board", 180.0, 55.0, 900.0, resolution=(17, 32))
    whole = trace_kernels(read_plant(plant), request, no_progress).kernels
    assert whole.is_whole
    assert whole.pixels.untyped_storage().nbytes() == 4 * 17 * 32
    each = replace(whole, is_whole=False, pixels=whole.pixels.contiguous())
    limit = torch.full_like(whole.areas, 30e3)
    one, other = (single_aim(kernels, limit) for kernels in (whole, each))
    torch.testing.assert_close(one.flux, other.flux)
    drawn, expected = linear_draws(one), linear_draws(other)
    torch.testing.assert_close(drawn.sigma, expected.sigma)
    np.testing.assert_allclose(drawn.ratios, expected.ratios, rtol=1e-5)
    thin, rough = (plan.kernels.thinned().kernels for plan in (one, other))
    moved = torch.full((len(whole), 2), 0.5)
    torch.testing.assert_close(thin.flux(moved), rough.flux(moved))


def test_parts_of_the_kernels_do_not_change_a_plan(plant: Path, monkeypatch: pytest.MonkeyPatch):
    """Light, draws and values are those of all pairs at once, and a pair takes 16 bytes."""
    request = FieldRequest("main", 180.0, 55.0, 900.0, resolution=(16, 40))
    read = read_plant(plant)
    whole = trace_kernels(read, request, no_progress).kernels
    assert whole.places.dtype == whole.factors.dtype == torch.float32
    pairs = [getattr(whole, name).nbytes for name in ("places", "factors", "pixels")]
    assert sum(pairs) == 16 * whole.pixels.numel() < 16 * len(whole) * 16 * 40
    limit = torch.full_like(whole.areas, 80e3)
    at_once = single_aim(whole, limit)
    moved = torch.zeros(len(whole), 2, requires_grad=True)
    (gradient,) = torch.autograd.grad(whole.flux(moved)[:300].sum(), moved)
    drawn, value, bound = linear_draws(at_once), mirror_values(at_once), bound_power(at_once, 1)
    for name in ("_PART", "_SAVED"):
        monkeypatch.setattr(kernels, name, 2000)
    monkeypatch.setattr(plan, "_DENSE", 2000)
    parts = trace_kernels(read, request, no_progress).kernels
    assert max(part.pixels.numel() for part, _ in parts.parts()) <= 2000
    in_parts = single_aim(parts, limit)
    assert torch.equal(in_parts.flux, at_once.flux)
    some = linear_draws(in_parts)
    assert torch.allclose(some.sigma, drawn.sigma)
    np.testing.assert_allclose(some.ratios, drawn.ratios, rtol=1e-5)
    assert torch.allclose(mirror_values(in_parts), value, rtol=1e-4)
    assert bound_power(in_parts, 1) == pytest.approx(bound, rel=1e-4)
    gradients = [gradient]
    gradients.append(torch.autograd.grad(parts.flux(moved)[:300].sum(), moved)[0])
    assert torch.allclose(*gradients, rtol=1e-3, atol=1e-2)


def test_too_many_pixels_for_the_heliostats_are_refused(plant: Path, tmp_path: Path):
    require_few_pairs(2650, (128, 128))
    with pytest.raises(InvalidInputError, match=r"^resolution: 1024 x 1024 .* the 16442 that"):
        require_few_pairs(2650, (1024, 1024))
    done = heliotwin(
        "aim", plant, "--receiver", "main", "--limit", 80, "--resolution", 1024, 1024, "--out",
        tmp_path / "aims.csv", "--report", tmp_path / "report.json", *SUN,
    )  # fmt: skip
    ends(done, 2, "resolution: 1024 x 1024 pixels for each of")
    assert not (tmp_path / "aims.csv").exists()


@pytest.mark.full
def test_uncertain_surfaces_widen_the_interval_of_the_peak(plant: Path, tmp_path: Path):
    known, uncertain = tmp_path / "known", tmp_path / "uncertain"
    for name, heliostat in read_plant(plant).plant.heliostats.items():
        points = control_points(heliostat)
        for folder, std in ((known, 0.0), (uncertain, 3e-3)):
            path = folder / name / "Deflectometry" / f"{name}-nurbs-surface.npz"
            path.parent.mkdir(parents=True)
            np.savez(path, control_points=points, z_std=np.full(points.shape[:3], std))
    reports = [
        aimed(plant, tmp_path, "board", 45, "--surfaces", folder) for folder in (known, uncertain)
    ]
    assert [report["surface_draws"] for report in reports] == [4, 4]
    assert reports[0]["power_w"] == pytest.approx(reports[1]["power_w"], rel=1e-6)
    (low, high), (least, most) = (report["peak_interval_w_m2"] for report in reports)
    assert most - least > 1.1 * (high - low)


def test_deviations_of_another_shape_are_refused(plant: Path, tmp_path: Path):
    heliostat = next(iter(read_plant(plant).plant.heliostats.values()))
    path = tmp_path / heliostat.name / "Deflectometry" / f"{heliostat.name}-nurbs-surface.npz"
    path.parent.mkdir(parents=True)
    np.savez(path, control_points=control_points(heliostat), z_std=np.zeros((1, 3, 3)))
    with pytest.raises(InvalidInputError, match="'z_std' must be finite"):
        read_height_std(tmp_path, heliostat)
