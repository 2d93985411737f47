"""The mounts of a field: from readings to calibrated mounts, steps, and what contradicts them."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from model.plant import Heliostat, TargetPlane
from model.pointing.calibration import Field, calibrate
from model.pointing.clock import Clock, find_clock
from model.pointing.covariates import Explained, explain
from model.pointing.drives import Noise
from model.pointing.kinematics import Chain
from model.pointing.mounts import CalibratedMount, mounts_of
from model.pointing.readings import Reading, padded
from model.pointing.reasons import Contradiction, Reasons


@dataclass(frozen=True, eq=False)
class FieldMounts:
    """A calibrated field.

    Attributes
    ----------
    field : Field
        What its heliostats share.
    mounts, readings : by heliostat
        Readings in order of time.
    contradictions : by heliostat and reading
        Readings that were left out.
    odd : tuple of str
        Heliostats whose property files have drives of another kind than the field's.
    clock : Clock or None
        A fault of the clock that was taken for steps. Mounts are calibrated by the suns as they were recorded.
    covariates : by name
        What time of day, season and weather explain of the errors that are left.
    """

    field: Field
    mounts: dict[str, CalibratedMount]
    readings: dict[str, list[Reading]]
    contradictions: dict[str, dict[str, Contradiction]]
    odd: tuple[str, ...] = ()
    clock: Clock | None = None
    covariates: dict[str, Explained] = dataclasses.field(default_factory=dict)


def calibrate_field(
    heliostats: Mapping[str, Heliostat],
    readings: Mapping[str, Sequence[Reading]],
    targets: Mapping[str, TargetPlane],
    *,
    latitude_deg: float,
    noise: Noise | None = None,
    field: Field | None = None,
) -> FieldMounts:
    """Calibrate the mounts of heliostats, all of which have actuators, by their readings in any order.

    ``field`` is the prior, by default the field's own; who has no reading gets the mount that it makes likely.
    """
    names = list(readings)
    ordered = {name: sorted(readings[name], key=lambda one: one.day) for name in names}
    own = [heliostats[name] for name in names]
    chain, arrays = Chain.of(own), padded(list(ordered.values()))
    done = calibrate(chain, arrays, noise, field)
    mounts = dict(zip(names, mounts_of(done, own, arrays), strict=True))
    reasons = Reasons(heliostats, mounts, targets, latitude_deg)
    contradictions = {
        name: {
            ordered[name][place].name: reasons.explain(name, ordered[name][place])
            for place in np.nonzero(mount.foreign)[0]
        }
        for name, mount in mounts.items()
    }
    odd = tuple(name for name, is_odd in zip(names, done.field.is_odd(chain), strict=True) if is_odd)
    kinds = [(np.arange(len(names)), done)]
    return FieldMounts(
        done.field,
        mounts,
        ordered,
        contradictions,
        odd,
        find_clock(kinds, arrays, latitude_deg),
        explain(kinds, arrays, list(ordered.values()), latitude_deg),
    )
