"""Calibrate a field: mounts, steps, outliers, clock faults and covariates of the readings."""

import dataclasses
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from model.plant import Heliostat, TargetPlane
from model.pointing.calibration import FieldPrior, calibrate, calibrate_kinds
from model.pointing.clock import ClockFault, find_clock_fault
from model.pointing.covariates import ExplainedShare, explain_errors
from model.pointing.drives import Noise
from model.pointing.kinematics import KinematicChain
from model.pointing.mounts import CalibratedMount, mounts_of
from model.pointing.prediction import with_predictions
from model.pointing.readings import Reading, pad_readings
from model.pointing.reasons import Contradiction, ContradictionClassifier
from model.site import Site


@dataclass(frozen=True, eq=False)
class FieldMounts:
    """A calibrated field.

    Attributes
    ----------
    prior : FieldPrior
        That of the largest kind of drives.
    mounts, readings : by heliostat
        Of the requested heliostats; readings in order of time.
    contradictions : by heliostat and reading
        Excluded readings.
    unusual : tuple of str
        Heliostats whose property files have drives of unusual lengths.
    clock : ClockFault or None
        A fault of the clock that looks like steps. Mounts are calibrated by the recorded suns.
    covariates : by name
        Shares of the remaining errors that time of day, season and weather explain.
    """

    prior: FieldPrior
    mounts: dict[str, CalibratedMount]
    readings: dict[str, list[Reading]]
    contradictions: dict[str, dict[str, Contradiction]]
    unusual: tuple[str, ...] = ()
    clock: ClockFault | None = None
    covariates: dict[str, ExplainedShare] = dataclasses.field(default_factory=dict)


def calibrate_field(
    heliostats: Mapping[str, Heliostat],
    readings: Mapping[str, Sequence[Reading]],
    targets: Mapping[str, TargetPlane],
    site: Site,
    *,
    noise: Noise | None = None,
    prior: FieldPrior | None = None,
    requested: Collection[str] | None = None,
) -> FieldMounts:
    """Calibrate the mounts of heliostats with actuators by their readings, in any order.

    Parameters
    ----------
    heliostats, readings, targets : by name
    site : Site
    noise : Noise, optional
    prior : FieldPrior, optional
        By default estimated from all heliostats with the same kind of drives. A heliostat without
        readings gets its mean.
    requested : names, optional
        Heliostats to return. The others contribute to the prior, and may be the source of a foreign
        spot.
    """
    names = list(readings)
    ordered = {
        name: sorted(readings[name], key=lambda reading: (np.isfinite(reading.day), reading.day))
        for name in names
    }
    chain = KinematicChain.of([heliostats[name] for name in names])
    arrays = pad_readings(list(ordered.values()))
    if prior is None:
        kinds = calibrate_kinds(chain, arrays, noise)
    else:
        kinds = [(np.arange(len(names)), calibrate(chain, arrays, noise, prior))]
    every: dict[str, CalibratedMount] = {}
    unusual: set[str] = set()
    for rows, done in kinds:
        of_kind = [names[row] for row in rows]
        every |= zip(
            of_kind,
            mounts_of(done, [heliostats[name] for name in of_kind], arrays.of(rows)),
            strict=True,
        )
        is_unusual = done.prior.is_unusual(chain.rows(rows))
        unusual |= {name for name, differs in zip(of_kind, is_unusual, strict=True) if differs}
    predicted = with_predictions([every[name] for name in names], kinds, arrays)
    every = dict(zip(names, predicted, strict=True))
    mounts = {name: every[name] for name in names if requested is None or name in requested}
    classifier = ContradictionClassifier(heliostats, every, targets, site)
    contradictions = {
        name: {
            ordered[name][place].name: classifier.classify(name, ordered[name][place])
            for place in np.nonzero(mount.foreign)[0]
        }
        for name, mount in mounts.items()
    }
    return FieldMounts(
        kinds[0][1].prior,
        mounts,
        {name: ordered[name] for name in mounts},
        contradictions,
        tuple(name for name in mounts if name in unusual),
        find_clock_fault(kinds, arrays, site),
        explain_errors(kinds, arrays, list(ordered.values()), site),
    )
