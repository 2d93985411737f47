"""Buttons that choose the active surface, undo the choice, and acknowledge warnings."""

from typing import Annotated

from fastapi import APIRouter, Form, Path, Response
from pydantic import Field

from service import store
from service.base.fields import Model, Text, Version
from service.store.surfaces import decisions
from service.store.surfaces.decisions import Justification
from service.web.auth.dependencies import OPERATE, IdentityDep, NamePath, RuntimeDep
from service.web.responses.pages import go_to

router = APIRouter(include_in_schema=False)


class TakeForm(Model):
    """The button, with an optional reason."""

    reason: Annotated[Text, Field(max_length=200)] = ""


@router.post("/heliostats/{name}/surfaces/{version}/take", dependencies=[OPERATE])
def post_take_form(
    name: NamePath,
    version: Annotated[Version, Path(description="Number of the version.")],
    form: Annotated[TakeForm, Form()],
    runtime: RuntimeDep,
    identity: IdentityDep,
) -> Response:
    """Make a version the active surface."""
    with runtime.database.writing() as session:
        heliostat = store.get_heliostat(session, name)
        surface = store.get_surface(session, heliostat, version)
        reason = form.reason or f"{identity.name} chose it"
        decisions.promote(session, heliostat, surface, identity.name, Justification(reason))
    return go_to(f"/heliostats/{name}#history-title")


@router.post("/heliostats/{name}/surfaces/{version}/acknowledge", dependencies=[OPERATE])
def post_acknowledge_form(
    name: NamePath,
    version: Annotated[Version, Path(description="Number of the version.")],
    runtime: RuntimeDep,
    identity: IdentityDep,
) -> Response:
    """Acknowledge that a surface is not trusted."""
    with runtime.database.writing() as session:
        heliostat = store.get_heliostat(session, name)
        decisions.acknowledge_warnings(
            session, heliostat, store.get_surface(session, heliostat, version), identity.name
        )
    return go_to(f"/heliostats/{name}")


@router.post("/heliostats/{name}/surfaces/undo", dependencies=[OPERATE])
def post_undo_form(name: NamePath, runtime: RuntimeDep, identity: IdentityDep) -> Response:
    """Undo the last decision."""
    with runtime.database.writing() as session:
        decisions.undo_decision(session, store.get_heliostat(session, name), identity.name)
    return go_to(f"/heliostats/{name}#history-title")
