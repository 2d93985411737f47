"""Times of many measurements, given afterwards."""

from fastapi import APIRouter, Depends
from pydantic import BaseModel, Field

from service.base.fields import MeasurementName, Model, Moment, Name, Reason
from service.twin.photographs.batches import MOST_ENTRIES, TIMES, correct_many
from service.twin.photographs.times import given_time
from service.web.auth.dependencies import (
    COMPUTE_SLOT,
    OPERATE,
    IdentityDep,
    RuntimeDep,
    require_json,
)
from service.web.responses.openapi import problems

router = APIRouter(prefix="/measurements", tags=["measurements"])


class TimeIn(Model):
    """The time of a measurement."""

    heliostat: Name
    id: MeasurementName
    taken_at: Moment = Field(description="With time zone.")


class TimesIn(Model):
    """Times of measurements whose time was unknown or wrong."""

    reason: Reason = Field(description="Where they come from; kept with each correction.")
    times: list[TimeIn] = Field(
        min_length=1,
        max_length=MOST_ENTRIES,
        description="The times, by heliostat and measurement.",
    )


class TimesOut(BaseModel):
    """Number of given times, and number of those that changed anything."""

    given: int = Field(description="How many times were given.")
    changed: int = Field(description="How many of them changed a measurement.")


@router.patch(
    "/times",
    responses=problems(404, 409, 410, 413, 415, 429),
    dependencies=[OPERATE, Depends(require_json), COMPUTE_SLOT],
)
def patch_times(runtime: RuntimeDep, identity: IdentityDep, body: TimesIn) -> TimesOut:
    """Set the times of many photographs.

    Either all are set, or none. Each is a correction with its history. `errors` names every wrong
    entry by its index, such as `times.3`. Entries that match the stored time are skipped.
    """
    given = [
        given_time(entry.heliostat, entry.id, entry.taken_at, body.reason) for entry in body.times
    ]
    changed = correct_many(runtime, given, body.reason, identity.name, TIMES)
    return TimesOut(given=len(given), changed=changed)
