"""A heliostat that sends less light is found, and haze, exposure and few photographs are not."""

from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from service.twin.alarms.measured_states import find_lost_light
from service.twin.studies.cameras import LightReading

FIRST = datetime(2026, 5, 1, 10, tzinfo=UTC)
SPREAD = 0.1
"""Standard deviation of a photograph's light: about a tenth."""


def readings(
    rng: np.random.Generator, heliostats: int = 12, days: int = 20, share: float = 0.0
) -> list[LightReading]:
    """Photographs of all heliostats on days of different haze.

    The first heliostat lost a ``share`` of its light in the last six days.
    """
    usual, haze = rng.normal(0.5, 0.3, heliostats), rng.normal(0, 0.3, days)
    lost = np.where(np.arange(days) >= days - 6, np.log1p(-share), 0.0)
    return [
        LightReading(
            number,
            "lower",
            FIRST + timedelta(days=day, minutes=number),
            (FIRST + timedelta(days=day)).date(),
            float(light + haze[day] + rng.normal(0, SPREAD) + (lost[day] if number == 0 else 0.0)),
        )
        for number, light in enumerate(usual)
        for day in range(days)
    ]


@pytest.mark.parametrize("share", [0.5, 0.6])
def test_a_soiled_mirror_is_found_with_its_day_and_share(share: float):
    rng = np.random.default_rng(1)
    for _ in range(20):
        (found,) = find_lost_light(readings(rng, share=share), 0.2)
        assert (found.heliostat, found.target) == (0, "lower")
        assert found.share == pytest.approx(share, abs=0.12)
        assert 0.2 < found.min_share <= found.share
        changed = FIRST + timedelta(days=14)
        assert found.before < changed <= found.since
        assert found.since - found.before <= timedelta(days=4)
        assert 4 <= found.photographs <= 7


def test_haze_and_noise_raise_nothing():
    rng = np.random.default_rng(2)
    assert all(find_lost_light(readings(rng), 0.2) == [] for _ in range(20))


def test_less_than_allowed_few_photographs_and_few_heliostats_raise_nothing():
    rng = np.random.default_rng(3)
    assert find_lost_light(readings(rng, share=0.5), 0.7) == []
    assert find_lost_light(readings(rng, days=7, share=0.6), 0.2) == []
    assert find_lost_light(readings(rng, heliostats=2, share=0.6), 0.2) == []
    assert find_lost_light([], 0.2) == []
