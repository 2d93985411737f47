"""Forms that exclude photographs, choose the active surface, undo that, acknowledge warnings."""

from typing import Annotated

from fastapi import APIRouter, Form, Path, Response
from pydantic import Field
from sqlalchemy.orm import Session

from service import store
from service.base.fields import MeasurementName, Model, ReadVersion, Reason, Text, Version
from service.store.surfaces import decisions
from service.twin.alarms.acknowledging import acknowledge_surface
from service.twin.photographs.corrections import GivenCorrection, correct_photographs
from service.twin.runtime.runtime import Runtime
from service.twin.surfaces.evaluation import justify_by_hand
from service.web.api.corrections import predict_again
from service.web.api.surfaces import SurfaceAcknowledgementIn
from service.web.auth.dependencies import (
    COMPUTE_SLOT,
    OPERATE,
    OVERVIEW_SLOT,
    IdentityDep,
    NamePath,
    RuntimeDep,
)
from service.web.responses.pages import go_to

router = APIRouter(include_in_schema=False)


class TakeForm(Model):
    """The button, with an optional reason, and the version that was active; 0 for none."""

    reason: Annotated[Text, Field(max_length=200)] = ""
    active: ReadVersion = None


def _decide(
    runtime: Runtime, name: str, version: int, became_active: bool, actor: str, form: TakeForm
) -> None:
    done = "chose it" if became_active else "kept the active surface"
    grounds = justify_by_hand(runtime, name, version, form.reason or f"{actor} {done}")
    runtime.database.run_in_transaction(
        lambda session: decisions.decide(
            session, name, version, became_active, actor, grounds, form.active
        )
    )


@router.post("/heliostats/{name}/surfaces/{version}/take", dependencies=[OPERATE])
def post_take_form(
    name: NamePath,
    version: Annotated[Version, Path(description="Number of the version.")],
    form: Annotated[TakeForm, Form()],
    runtime: RuntimeDep,
    identity: IdentityDep,
) -> Response:
    """Make a version the active surface."""
    _decide(runtime, name, version, True, identity.name, form)
    return go_to(f"/heliostats/{name}#history-title")


@router.post("/heliostats/{name}/surfaces/{version}/keep", dependencies=[OPERATE])
def post_keep_form(
    name: NamePath,
    version: Annotated[Version, Path(description="Number of the version.")],
    form: Annotated[TakeForm, Form()],
    runtime: RuntimeDep,
    identity: IdentityDep,
) -> Response:
    """Keep the active surface instead of a candidate."""
    _decide(runtime, name, version, False, identity.name, form)
    return go_to(f"/heliostats/{name}#history-title")


class DecisionUndoForm(Model):
    """The button that undoes a decision; without its number, the last one."""

    decision: ReadVersion = None


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
    given = [
        GivenCorrection(name, photograph, form.reason, excluded=form.excluded)
        for photograph in form.photographs
    ]
    correct_photographs(runtime, given, identity.name, form.version)
    if form.predict_again:
        return go_to(f"/jobs/{predict_again(runtime, name, identity.name)}")
    return go_to(f"/heliostats/{name}#excluded-title")


@router.post(
    "/heliostats/{name}/surfaces/{version}/acknowledge", dependencies=[OPERATE, OVERVIEW_SLOT]
)
def post_acknowledge_form(
    name: NamePath,
    version: Annotated[Version, Path(description="Number of the version.")],
    form: Annotated[SurfaceAcknowledgementIn, Form()],
    runtime: RuntimeDep,
    identity: IdentityDep,
) -> Response:
    """Acknowledge that a surface is not trusted, as its alarm."""
    acknowledge_surface(runtime, name, version, identity.name, form.reason)
    return go_to(f"/heliostats/{name}#warnings-title")


@router.post("/heliostats/{name}/surfaces/undo", dependencies=[OPERATE])
def post_undo_form(
    name: NamePath,
    form: Annotated[DecisionUndoForm, Form()],
    runtime: RuntimeDep,
    identity: IdentityDep,
) -> Response:
    """Undo the last decision."""

    def undo(session: Session) -> None:
        heliostat = store.get_heliostat(session, name)
        decisions.undo_decision(session, heliostat, identity.name, decision=form.decision)

    runtime.database.run_in_transaction(undo)
    return go_to(f"/heliostats/{name}#history-title")
