import numpy as np
import pytest

from model.imaging.separate import bridge_dark_features, find_spots, separate
from tests.imaging import accuracy, gaussian


def test_the_background_is_recovered_under_the_spot(plane, spot):
    y, x = np.mgrid[-1:1:256j, -1:1:256j]
    sheet = 120 + 15 * x - 20 * y + 8 * x * y
    parts = separate((sheet + 80 * spot).clip(0, 255).round().astype(np.uint8))
    assert np.abs(parts.background - sheet).max() < 3.0
    assert accuracy(parts.flux, spot) > 0.97


def test_a_shadow_edge_is_not_taken_for_light(plane, spot):
    y, x = np.mgrid[-1:1:256j, -1:1:256j]
    sheet = np.where(y > 0.4 * x + 0.75, 135.0, 122.0)
    parts = separate((sheet + 80 * spot).round().astype(np.uint8))
    assert accuracy(parts.flux, spot) > 0.9


def test_lines_and_rivets_are_bridged(spot):
    crop = 120 + 80 * spot
    crop[::32] *= 0.85
    crop[:, ::40] *= 0.85
    crop[16::32, 20::40] *= 0.4
    filled, _ = bridge_dark_features(crop.round().astype(np.uint8))
    assert np.abs(filled - (120 + 80 * spot)).mean() < 1.0
    assert accuracy(separate(crop.round().astype(np.uint8)).flux, spot) > 0.95


def test_the_spot_with_more_energy_is_the_main_one(plane, spot):
    other = 0.7 * gaussian(plane, -1.9, 2.2, 0.35, 0.35)
    parts = separate((120 + 80 * (spot + other)).round().astype(np.uint8))
    assert parts.main[np.unravel_index(spot.argmax(), spot.shape)]
    assert parts.foreign[np.unravel_index(other.argmax(), other.shape)]
    assert accuracy(parts.flux, spot) > 0.95


def test_overlapping_spots_are_parted_and_lobes_are_not(plane):
    main, other = gaussian(plane, 0.6, -0.6, 0.6, 0.6), 0.8 * gaussian(plane, -1.2, 1.2, 0.4, 0.4)
    smooth = (80 * (main + other)).astype(np.float32)
    kept, foreign = find_spots(smooth, noise=0.5)
    assert foreign.any()
    assert kept[np.unravel_index(main.argmax(), main.shape)]
    lobes = gaussian(plane, 0.5, 0, 0.35, 0.35) + gaussian(plane, -0.35, 0.3, 0.35, 0.35)
    kept, foreign = find_spots((80 * lobes).astype(np.float32), noise=0.5)
    assert not foreign.any()


@pytest.mark.parametrize("value", [0, 3, 128, 255])
def test_a_blank_image_holds_no_spot(value):
    parts = separate(np.full((256, 256), value, np.uint8))
    assert not parts.main.any()
    assert parts.flux.sum() == 0


def test_the_gap_between_a_spot_and_the_edge_is_no_mark(plane):
    spot = gaussian(plane, 1.9, 0.3, 0.3, 0.4)
    filled, hidden = bridge_dark_features((120 + 90 * spot).round().astype(np.uint8))
    assert not hidden.any()
    assert np.abs(filled - (120 + 90 * spot)).max() < 2.0


def test_touching_spots_are_parted(plane):
    spot, other = (
        gaussian(plane, 0.4, -0.4, 0.9, 0.4, 0.8),
        0.9 * gaussian(plane, -0.9, 0.9, 0.3, 0.3),
    )
    parts = separate((120 + 80 * (spot + other)).round().astype(np.uint8))
    assert parts.foreign[np.unravel_index(other.argmax(), other.shape)]
    assert accuracy(parts.flux, spot) > 0.9
