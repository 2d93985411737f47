"""Measure the states of mirrors in operation by photographs: their dimming and pointing errors."""

import math
from collections.abc import Sequence

import numpy as np
from scipy.stats import chi2

from service import store
from service.twin.alarms.field_overview import HeliostatOverview, read_summaries, with_pointing
from service.twin.alarms.light import find_lost_light
from service.twin.forecasts.mirror_states import (
    AS_DECLARED,
    CLEANLINESS_RANGE,
    MRAD_RANGE,
    Estimate,
    MirrorStates,
)
from service.twin.forecasts.requests import ForecastIn
from service.twin.pointing.errors import PointingState
from service.twin.runtime import Runtime
from service.twin.studies.camera_watch import CameraWatch, LightReading, camera_watch

# Lost share of the light above which a mirror counts as dimmed. Less is not distinct from haze.
_MIN_LOSS = 0.05
# Median of a Rayleigh distribution, in standard deviations per axis.
_MEDIAN = math.sqrt(2 * math.log(2))


def read_mirror_states(runtime: Runtime, names: Sequence[str]) -> MirrorStates:
    """Measure the present states of heliostats; no session should be open."""
    settings, wanted, watch = runtime.settings, set(names), CameraWatch()
    with runtime.database.reading() as session:
        only = None
        if len(names) == 1:  # at each forecast of a heliostat: earlier days are cached
            only = store.get_heliostat(session, names[0]).id
            watch = camera_watch(runtime.database)
        lines = [line for line in read_summaries(session, only) if line.name in wanted]
        light = watch.read(session, settings).light
    lines = [with_pointing(runtime, line) for line in lines]
    return measure_states(lines, light, settings.default_pointing_error_mrad)


def read_requested_states(runtime: Runtime, request: ForecastIn) -> MirrorStates:
    """The states in which a request asks for its mirror: measured, or as declared."""
    is_measured = request.measured_states and request.surface != "ideal"
    return read_mirror_states(runtime, [request.heliostat]) if is_measured else AS_DECLARED


def measure_states(
    lines: Sequence[HeliostatOverview], light: Sequence[LightReading], default_mrad: float = 0.0
) -> MirrorStates:
    """Measure the states of heliostats by their pointing and the light of all photographs."""
    lost = sorted(find_lost_light(light, _MIN_LOSS), key=lambda one: one.photographs)
    name_of = {line.id: line.name for line in lines}
    cleanliness = {
        name_of[one.heliostat]: Estimate(
            _left(one.share), (_left(one.max_share), _left(one.min_share))
        )
        for one in lost
        if one.heliostat in name_of
    }
    errors = {line.name: predicted_pointing_error(line.pointing) for line in lines}
    pointing = {name: error for name, error in errors.items() if error is not None}
    return MirrorStates(cleanliness, pointing, default_mrad)


def _left(share: float) -> float:
    """What a lost share of the light leaves."""
    return float(np.clip(1 - share, *CLEANLINESS_RANGE))


def predicted_pointing_error(state: PointingState | None) -> Estimate | None:
    """Standard deviation per axis [mrad] of a heliostat's beam by photographs.

    None if its mount was not calibrated, or too few photographs say how well it predicts spots.
    Angles of two axes have a Rayleigh distribution.
    """
    if state is None or state.error_mrad is None:
        return None
    sigma, freedom = state.error_mrad / _MEDIAN, 2 * state.photographs
    ends = (sigma * math.sqrt(freedom / chi2.ppf(p, freedom)) for p in (0.975, 0.025))
    value, low, high = (min(one, MRAD_RANGE[1]) for one in (sigma, *ends))
    return Estimate(value, (low, high))
