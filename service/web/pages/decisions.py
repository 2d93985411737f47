"""The form that excludes photographs of a heliostat, or uses them again."""

from typing import Annotated

from fastapi import APIRouter, Form, Response
from pydantic import Field

from service.base.fields import MeasurementName, Model, ReadVersion, Reason
from service.twin.photographs.corrections import (
    GivenCorrection,
    PhotographChanges,
    correct_photographs,
)
from service.web.api.corrections import predict_again
from service.web.auth.dependencies import COMPUTE_SLOT, OPERATE, IdentityDep, NamePath, RuntimeDep
from service.web.responses.pages import go_to

router = APIRouter(include_in_schema=False)


class ExclusionForm(Model):
    """Photographs to exclude, or to use again, with the reason."""

    photographs: Annotated[list[MeasurementName], Field(min_length=1, max_length=100)]
    reason: Reason
    excluded: bool = True
    predict_again: bool = False
    version: ReadVersion = None


@router.post("/heliostats/{name}/exclusions", dependencies=[OPERATE, COMPUTE_SLOT])
def post_exclusion_form(
    name: NamePath,
    form: Annotated[ExclusionForm, Form()],
    runtime: RuntimeDep,
    identity: IdentityDep,
) -> Response:
    """Exclude photographs or use them again, and go to the job that predicts the surface again."""
    changes = PhotographChanges(form.reason, excluded=form.excluded)
    given = [GivenCorrection(name, photograph, changes) for photograph in form.photographs]
    correct_photographs(runtime, given, identity.name, form.version)
    if form.predict_again:
        return go_to(f"/jobs/{predict_again(runtime, name, identity.name)}")
    return go_to(f"/heliostats/{name}#excluded-title")
