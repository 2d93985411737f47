"""Detect photographs of a mirror that contradict the others.

Causes are a neighbour's shadow, a cloud or another heliostat's light. The network predicts a
surface from some of the photographs. This surface explains most photographs about equally well, and
outliers far worse. Of 85 photographs of AA39 over two years, eight are outliers. The measured
mirror explains the same eight worst, and the network did not see it (``python -m
benchmarks.light --consensus``).
"""

from collections.abc import Sequence

import numpy as np

from model.metrics import flux_accuracy
from model.network.architecture import MAX_IMAGES
from model.observation import Observation
from model.plant import Heliostat
from model.plant_model import PlantModel
from service.base.choices import Selection
from service.twin.heliostats.measurements import choose_diverse
from service.twin.runtime import Operations

# Fewer photographs cannot outvote a wrong one.
_FEWEST = 6
_DEVIATIONS = 3.0
# Least excess of an outlier's misfit [flux accuracy], because clean images almost agree.
_LEAST = 0.05


def reject_outliers(
    operations: Operations,
    heliostat: Heliostat,
    observations: Sequence[Observation],
    model: PlantModel,
) -> Selection[Observation]:
    """Remove outliers from observations; the others are in order of time, unknown times first.

    Of mirrors without a network none is removed: their refinement excludes images itself.
    """
    observations = sorted(observations, key=_time)
    if len(observations) < _FEWEST or not operations.has_network(heliostat):
        return Selection(observations, {})
    glance = operations.predict(heliostat, choose_diverse(observations, MAX_IMAGES), model)
    images = operations.render(heliostat, observations, glance.z, model).clip(min=0)
    misfits = [
        1 - flux_accuracy(o.flux, image) for o, image in zip(observations, images, strict=True)
    ]
    undated = sum(o.taken_at is None for o in observations)
    apart, usual = list_outliers(misfits, undated), float(np.median(misfits))
    reasons = {
        observations[row].identifier: (
            f"contradicts the others: it differs by {misfits[row]:.2f} from what they show"
            f" together, they by {usual:.2f}; a shadow, a cloud or another heliostat's light may"
            " lie on it"
        )
        for row in apart
    }
    return Selection([o for row, o in enumerate(observations) if row not in apart], reasons)


def _time(observation: Observation) -> float:
    taken = observation.taken_at
    return -np.inf if taken is None else taken.timestamp()


def list_outliers(misfits: Sequence[float], undated: int = 0) -> list[int]:
    """Indices of misfits that exceed the median by three robust deviations (median, MAD).

    The misfits are in order of time. If all of the last ones are outliers, they are not listed,
    because the mirror may have changed. The first ``undated`` have no order in time and never count
    as the last.
    """
    values = np.asarray(misfits)
    above = values - np.median(values)
    apart = above > max(_LEAST, _DEVIATIONS * 1.4826 * float(np.median(np.abs(above))))
    settled = max(np.flatnonzero(~apart)[-1] + 1, undated)
    return [int(row) for row in np.flatnonzero(apart[:settled])]
