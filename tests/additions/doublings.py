"""A kind of job."""

from service.base.fields import Model
from service.jobs.kind import Context, Kind, Result


class DoublingIn(Model):
    value: int


def double(context: Context, payload: DoublingIn) -> Result:
    return Result({"doubled": 2 * payload.value})


KIND = Kind("doublings", DoublingIn, double, "Double a number.")
