"""The job `calibrations`: mounts from motor positions and focal spots."""

from dataclasses import asdict

from pydantic import Field

from model.pointing.report import clock_to_json
from service.base.fields import Model, Moment
from service.jobs.kind import Context, Heliostats, Kind, Result, chosen_names
from service.twin.calibration import calibrate_store, store_mounts


class CalibrationIn(Model):
    """Calibrate the mounts of many heliostats together from stored motor positions and spots."""

    heliostats: Heliostats = None
    since: Moment | None = Field(
        default=None, description="Only measurements of a known time, from then on (with zone)."
    )
    until: Moment | None = Field(
        default=None, description="Only measurements of a known time, before then (with zone)."
    )


def calibrate_many(context: Context, payload: CalibrationIn) -> Result:
    """Store a new version of each heliostat's mount, once even if the job restarts."""
    if "mounts" not in context.steps():
        names = chosen_names(context.runtime, payload.heliostats)
        context.report(0.0, f"{len(names)} heliostats", phase="mounts of all heliostats at once")
        calibrated = calibrate_store(context.runtime, names, payload.since, payload.until)
        field = calibrated.done
        with context.runtime.database.writing() as session:
            rows = store_mounts(session, calibrated)
            figures = {
                "mounts": {name: row.version for name, row in rows.items()},
                "steps": {
                    name: row.document["steps"]
                    for name, row in rows.items()
                    if row.document["steps"]
                },
                "outliers": {
                    f"{name}/{reading}": {"reason": outlier.reason, "detail": outlier.detail}
                    for name, outliers in field.contradictions.items()
                    for reading, outlier in outliers.items()
                },
                "clock": clock_to_json(field.clock),
                "undated": asdict(calibrated.undated),
                "skipped": calibrated.skipped,
            }
            context.keep(session, "mounts", figures)
    return Result(context.steps()["mounts"])


KIND = Kind(
    "calibrations",
    CalibrationIn,
    calibrate_many,
    "Calibrate mounts from motor positions and spots.",
)
