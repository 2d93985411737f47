"""The generator by itself: it shares nothing with the product, keeps energy, and the truth explains
what it makes.
"""

import ast
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from benchmarks.folders import read_photographs
from heliotwin.folder_store import open_folder
from model.ephemeris import sun_angles_at
from model.forecast import View, align
from model.frames import sun_direction
from model.images import clipped_alike
from model.metrics import compare_on_target
from model.plant_model import JUELICH_MODEL
from model.study import FluxImage
from service.sources.folder import MeasurementFolder, read_folder
from tests.undeclared import changes, sky
from tests.undeclared.adapter import effects_of, write_folder
from tests.undeclared.camera import drawn_sheet, empty_targets, real_sheet, sheet
from tests.undeclared.generator import MeasurementSet, generate_season
from tests.undeclared.plan import Plan, season
from tests.undeclared.rays import Sun, throw
from tests.undeclared.world import World

STRONG = 2

Season = tuple[MeasurementSet, MeasurementFolder]


@cache
def plans() -> list[Plan]:
    return season((4, 4), np.random.default_rng(1))


@pytest.fixture(scope="module")
def a_season(tmp_path_factory) -> Callable[[str], Season]:
    """A short season of a case, and the folder that was written of it."""

    @cache
    def made(case: str) -> Season:
        photographed = generate_season(case, STRONG, 2, days=(3, 3), side=128, fan=16)
        return photographed, read_folder(write_folder(photographed, tmp_path_factory.mktemp(case)))

    return made


def test_only_the_adapter_knows_the_product():
    for path in Path(__file__).parent.glob("*.py"):
        if path.stem == "adapter" or path.stem.startswith("test_"):
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not {name.split(".")[0] for name in names} & {"model", "service", "training"}, (
                path.name
            )


def test_its_almanac_agrees_with_the_products():
    for plan in plans():
        true_sun = sun_direction(*sun_angles_at(plan.moment, sky.PLACE))
        assert np.degrees(np.arccos(plan.sun() @ true_sun)) < 0.2


def test_rays_carry_what_the_mirror_collects():
    """1000 W/m2, say, times area and cosine: four facets of 1.605 m x 1.275 m."""
    rng, fan = np.random.default_rng(1), 8
    sun = Sun.of(0.02, 0.0, rng)
    for plan in plans()[:3]:
        exposure = plan.exposure(World())
        cosine = float(exposure.stand().attitude[:, 2] @ plan.sun())
        light = sum(float(light.sum()) for _, light in throw(exposure, sun, 64, fan, rng)) / fan
        assert light == pytest.approx(4 * 1.605 * 1.275 * cosine, rel=0.008)


def test_a_drawn_sheet_is_as_real_ones_are(stj: Path):
    """White but for its marks, with seams, stains and grain of their strength."""
    sheets = drawn_sheet("lower"), real_sheet("lower", empty_targets())
    for paint in sheets:
        assert np.median(paint) == pytest.approx(1, abs=0.05)
        assert 0 < paint.min() < 0.2
        assert 0.005 < (paint < 0.5).mean() < 0.03
    inner = [paint[20:180, 20:-20] for paint in sheets]  # where spots are, and no marks
    for size in (0.0, 2.0, 14.0):
        drawn, real = (gaussian_filter(paint, size).std() for paint in inner)
        assert 0.5 < drawn / real < 1.5
    assert (real_sheet("upper", empty_targets()) == sheets[1][:, ::-1]).all()


def test_a_sheet_is_drawn_where_there_are_no_photographs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("HELIOTWIN_STJ", str(tmp_path))
    sheet.cache_clear()
    assert (sheet("lower") == drawn_sheet("lower")).all()
    sheet.cache_clear()


def test_times_agree_with_the_sun(a_season):
    made, folder = a_season("calm")
    with open_folder(folder) as opened:
        assert opened.clocks() == {}
        stored = [opened.measurements(name) for name in opened.names]
    assert sum(map(len, stored)) == len(made.plans)


def test_photographs_are_measured_back_to_the_light_that_was_on_the_sheet(a_season):
    made, folder = a_season("calm")
    photographs, skipped = read_photographs(folder)
    light = {
        f"{plan.heliostat.name}/{identifier}": image
        for plan, identifier, image in zip(made.plans, made.identifiers, made.light, strict=True)
    }
    assert not skipped
    assert any(p.clipped is not None for p in photographs)
    assert np.mean([_accuracy(p, light[p.key]) for p in photographs]) > 0.94


@pytest.mark.parametrize("case", [name for name in changes.CHANGES if not name.endswith("always")])
def test_the_model_with_the_truth_explains_a_season(a_season, case):
    """At each time by what is in force then; neither a law of sheet and spot together nor two
    cameras are in words.
    """
    made, folder = a_season(case)
    photographs, _ = read_photographs(folder)
    setups = [p.setup for p in photographs]
    view = View(256, 256)
    with_truth, without = (
        align(setups, JUELICH_MODEL.with_effects(effects))
        .images(view)
        .double()
        .clamp(min=0)
        .numpy()
        for effects in (effects_of(made), [])
    )
    after, before = (
        np.array([_accuracy(p, image) for p, image in zip(photographs, images, strict=True)])
        for images in (with_truth, without)
    )
    if case in ("law_since", "two_cameras"):
        assert 0.88 < after.mean() < 0.95
    else:
        changed = np.abs(after - before) > 1e-4
        assert after.mean() > 0.93
        assert changed.any() == (case != "calm")
        assert case == "calm" or (after - before)[changed].mean() > 0.005


def _accuracy(photograph: FluxImage, light: np.ndarray) -> float:
    """Of light (256, 256) over the whole target, cut off where the photograph is."""
    plane, clipped = photograph.setup.plane, photograph.clipped
    if clipped is not None:
        light = clipped_alike(light, photograph.image, clipped.astype(float))
    return compare_on_target(photograph.image, light, (plane.width, plane.height), 6.0, 32).accuracy
