"""The mounts of a field: from readings to calibrated mounts, steps, and what contradicts them."""

import dataclasses
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from model.plant import Heliostat, TargetPlane
from model.pointing.calibration import Field, calibrate, calibrate_kinds
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
        What its heliostats share; of several kinds of drives, those of the largest.
    mounts, readings : by heliostat
        Of those that were wanted; readings in order of time.
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
    wanted: Collection[str] | None = None,
) -> FieldMounts:
    """Calibrate the mounts of heliostats, all of which have actuators, by their readings in any order.

    ``field`` is the prior, by default what those with drives of one kind make together; who has no reading gets the
    mount that it makes likely. Where mounts of some are ``wanted``, the others make the prior with them, and are among
    those that a spot may be of.
    """
    names = list(readings)
    ordered = {name: sorted(readings[name], key=lambda one: one.day) for name in names}
    chain, arrays = Chain.of([heliostats[name] for name in names]), padded(list(ordered.values()))
    if field is None:
        kinds = calibrate_kinds(chain, arrays, noise)
    else:
        kinds = [(np.arange(len(names)), calibrate(chain, arrays, noise, field))]
    every: dict[str, CalibratedMount] = {}
    odd: set[str] = set()
    for rows, done in kinds:
        of_kind = [names[row] for row in rows]
        every |= zip(of_kind, mounts_of(done, [heliostats[name] for name in of_kind], arrays.of(rows)), strict=True)
        odd |= {name for name, is_odd in zip(of_kind, done.field.is_odd(chain.rows(rows)), strict=True) if is_odd}
    mounts = {name: every[name] for name in names if wanted is None or name in wanted}
    reasons = Reasons(heliostats, every, targets, latitude_deg)
    contradictions = {
        name: {
            ordered[name][place].name: reasons.explain(name, ordered[name][place])
            for place in np.nonzero(mount.foreign)[0]
        }
        for name, mount in mounts.items()
    }
    return FieldMounts(
        kinds[0][1].field,
        mounts,
        {name: ordered[name] for name in mounts},
        contradictions,
        tuple(name for name in mounts if name in odd),
        find_clock(kinds, arrays, latitude_deg),
        explain(kinds, arrays, list(ordered.values()), latitude_deg),
    )
