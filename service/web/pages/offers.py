"""Do what an alarm or a cause offers, from the button of a page."""

from typing import Annotated

from fastapi import APIRouter, Form, Response
from pydantic import BaseModel, StringConstraints

from model.errors import InvalidInputError
from service.base.fields import Lines
from service.jobs.kinds import KINDS
from service.web.auth.dependencies import COMPUTE_SLOT, OPERATE, IdentityDep, RuntimeDep
from service.web.resources.alarms import AcknowledgementsIn, post_acknowledgements
from service.web.resources.corrections import (
    CorrectionIn,
    ExclusionForm,
    TimesIn,
    patch_times,
    post_exclusion_form,
)
from service.web.resources.studies import AdoptIn, WithdrawIn, adopt_study, withdraw_study
from service.web.resources.surfaces import ChoiceIn, put_current_surface
from service.web.responses.pages import go_to, go_to_job, named_by_field

router = APIRouter(include_in_schema=False)

_OF_FORM = {"reason", "excluded", "predict_again"}


class ChosenOffer(BaseModel):
    """The request of an `Offer`, and the page to return to."""

    path: str
    body: dict[str, object]
    back: Annotated[str, StringConstraints(pattern=r"^/(alarms|heliostats/)")]


@router.post("/offers", dependencies=[OPERATE, COMPUTE_SLOT])
def post_offer_form(
    offer: Annotated[Lines, Form()], runtime: RuntimeDep, identity: IdentityDep
) -> Response:
    """Do the request as REST does, and go to its job or study, or back to the page."""
    with named_by_field():
        chosen = ChosenOffer.model_validate_json(offer)
        body = chosen.body
        match chosen.path.split("/")[1:]:
            case ["v1", "jobs", kind] if kind in KINDS:
                payload = KINDS[kind].payload.model_validate(body)
                return go_to_job(runtime, KINDS[kind], payload, identity)
            case ["v1", "studies", number, "adopt"] if number.isdecimal():
                adopt_study(int(number), runtime, identity, AdoptIn.model_validate(body))
                return go_to(f"/studies/{number}")
            case ["v1", "studies", number, "withdraw"] if number.isdecimal():
                withdraw_study(int(number), runtime, identity, WithdrawIn.model_validate(body))
                return go_to(f"/studies/{number}")
            case ["v1", "heliostats", name, "measurements", number]:
                asked = CorrectionIn.model_validate(body)
                form = ExclusionForm(photographs=[number], **asked.model_dump(include=_OF_FORM))
                return post_exclusion_form(name, form, runtime, identity)
            case ["v1", "heliostats", name, "surfaces", "current"]:
                put_current_surface(name, runtime, identity, ChoiceIn.model_validate(body), None)
            case ["v1", "measurements", "times"]:
                patch_times(runtime, identity, TimesIn.model_validate(body))
            case ["v1", "alarms", "acknowledgements"]:
                post_acknowledgements(runtime, identity, AcknowledgementsIn.model_validate(body))
            case _:
                raise InvalidInputError(f"offer: no page offers {chosen.path}")
    return go_to(chosen.back)
