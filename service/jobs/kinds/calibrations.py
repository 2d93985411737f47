"""The job `calibrations`: mounts from motors and spots."""

from pydantic import Field

from model.pointing.report import clock_to_json
from service.base.fields import Model, Moment
from service.jobs.common import Heliostats, chosen_names
from service.jobs.kind import Context, Kind, Result
from service.twin.pointing import calibrate_store, keep_mounts


class CalibrationIn(Model):
    """Calibrate the mounts of many heliostats together, from their stored motor positions and spots."""

    heliostats: Heliostats = None
    since: Moment | None = Field(default=None, description="Only photographs from then on (time with zone).")
    until: Moment | None = Field(default=None, description="Only photographs before then (time with zone).")


def calibrate_many(context: Context, payload: CalibrationIn) -> Result:
    """A new version of each heliostat's mount, once however often the job is begun."""
    if "mounts" not in context.steps():
        names = chosen_names(context.runtime, payload.heliostats)
        context.report(0.0, f"{len(names)} heliostats")
        calibrated = calibrate_store(context.runtime, names, payload.since, payload.until)
        done = calibrated.done
        with context.runtime.database.writing() as session:
            kept = keep_mounts(session, calibrated)
            figures = {
                "mounts": {name: row.version for name, row in kept.items()},
                "steps": {name: row.document["steps"] for name, row in kept.items() if row.document["steps"]},
                "outliers": {
                    f"{name}/{reading}": {"reason": one.reason, "detail": one.detail}
                    for name, own in done.contradictions.items()
                    for reading, one in own.items()
                },
                "clock": clock_to_json(done.clock),
                "skipped": calibrated.skipped,
            }
            context.keep(session, "mounts", figures)
    return Result(context.steps()["mounts"])


KIND = Kind("calibrations", CalibrationIn, calibrate_many, "Calibrate mounts from motor positions and spots.")
