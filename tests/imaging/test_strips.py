"""Large images are measured strip by strip: the same result with little memory."""

import tracemalloc

import numpy as np
import pytest

from model.imaging import strips
from model.imaging.light import Camera, Power
from model.imaging.measure import measure
from model.imaging.strips import convert_by_strips
from model.plant import TargetPlane

_, NORTH, UP = np.eye(3)
PLANE = TargetPlane("target", 40 * UP, NORTH, UP, 8.0, 8.0)


def photograph(
    depth: type[np.uint8 | np.uint16], channels: int = 3, sheet: float = 0.3
) -> np.ndarray:
    """A spot on a target of (600, 500) pixels, which daylight lights up to ``sheet`` of the
    camera's range.
    """
    rng = np.random.default_rng(3)
    y, x = np.mgrid[-1:1:600j, -1:1:500j]
    gray = sheet + 0.6 * np.exp(-(x**2 + y**2) / 0.05) + sheet * rng.normal(0, 0.03, x.shape)
    counts = (np.clip(gray, 0, 0.95) * np.iinfo(depth).max).astype(depth)
    return counts if channels == 1 else np.stack([counts, counts // 2, counts // 3], axis=-1)


@pytest.mark.parametrize("kind", ["flux", "cropped"])
@pytest.mark.parametrize("depth", [np.uint8, np.uint16])
@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("camera", [None, Camera(Power(2.0))])
def test_strips_change_nothing(monkeypatch, kind, depth, channels, camera):
    image = photograph(depth, channels, 0.0 if kind == "flux" else 0.3)
    whole = measure(image, kind, PLANE, camera=camera)
    monkeypatch.setattr(strips, "_STRIP_PIXELS", 7 * image.shape[1])
    parts = measure(image, kind, PLANE, camera=camera)
    assert whole.quality == parts.quality
    assert whole.flux is not None
    np.testing.assert_allclose(parts.flux, whole.flux, rtol=1e-5, atol=1e-7)


def test_conversion_may_have_other_axes_and_types():
    image = np.arange(60, dtype=np.uint16).reshape(5, 4, 3)
    assert (
        convert_by_strips(image, lambda strip: strip.max(axis=2)).tolist()
        == image.max(axis=2).tolist()
    )
    assert convert_by_strips(image[:, :, 0], lambda strip: strip / 2).dtype == np.float64


@pytest.mark.full
@pytest.mark.parametrize("kind", ["flux", "cropped", "raw"])
def test_a_large_photograph_takes_little_more_than_its_light(kind):
    """16 bytes for each pixel; index arrays and colours in floating point took some 40."""
    image = np.tile(photograph(np.uint16), (5, 6, 1))
    pixels = image.shape[0] * image.shape[1]
    tracemalloc.start()
    try:
        measure(image, kind, PLANE)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 16 * pixels + 2**28
