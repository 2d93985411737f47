"""Photographs of one mirror that contradict its others: a neighbour's shadow, a cloud, another heliostat's light.

A glance of the network at some of them gives a surface; held against all, it explains most about equally well, and a
few far worse. Of 85 photographs of AA39 over two years eight stand out, and they are the eight that the measured mirror
explains worst, which nobody has shown to the network (``python -m tests.benchmarks.light --consensus``).
"""

from collections.abc import Sequence

import numpy as np

from model.effects import Effect
from model.metrics import flux_accuracy
from model.network.architecture import MAX_IMAGES
from model.observation import Observation
from model.plant import Heliostat
from model.tracing import Optics
from service.twin.evidence import choose
from service.twin.runtime import Operations

# Fewer cannot outvote one that is wrong.
_FEWEST = 6
_DEVIATIONS = 3.0
# What contradicts others explains at least this much less [of flux accuracy]: clean images all but agree.
_LEAST = 0.05


def agreeing(
    operations: Operations,
    heliostat: Heliostat,
    observations: Sequence[Observation],
    optics: Optics | None = None,
    effects: Sequence[Effect] = (),
    *,
    latitude_deg: float,
) -> tuple[list[Observation], dict[str, str]]:
    """Observations, in the order they were taken, without those that contradict the others; why, by identifier."""
    if len(observations) < _FEWEST:
        return list(observations), {}
    model = optics, effects
    glance = operations.predict(
        heliostat, choose(observations, MAX_IMAGES), "network", *model, latitude_deg=latitude_deg
    )
    images = operations.render(heliostat, observations, glance.z, *model, latitude_deg=latitude_deg).clip(min=0)
    misfits = [1 - flux_accuracy(o.flux, image) for o, image in zip(observations, images, strict=True)]
    apart, usual = contradicting(misfits), float(np.median(misfits))
    reasons = {
        observations[row].identifier: f"contradicts the others: it differs by {misfits[row]:.2f} from what they show "
        f"together, they by {usual:.2f}; a shadow, a cloud or another heliostat's light may lie on it"
        for row in apart
    }
    return [o for row, o in enumerate(observations) if row not in apart], reasons


def contradicting(misfits: Sequence[float]) -> list[int]:
    """Places of the misfits, in order of time, that stand out by three robust deviations (median, MAD).

    Where the last ones all stand out they stay: the mirror itself may have changed.
    """
    values = np.asarray(misfits)
    above = values - np.median(values)
    apart = above > max(_LEAST, _DEVIATIONS * 1.4826 * float(np.median(np.abs(above))))
    settled = np.flatnonzero(~apart)[-1] + 1
    return [int(row) for row in np.flatnonzero(apart[:settled])]
