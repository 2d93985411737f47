"""Which surface is today's: the buttons that decide it and take it back, and who has seen its doubts."""

from typing import Annotated

from fastapi import APIRouter, Form, Path, Response

from service import store
from service.base.fields import Model, Version
from service.store import decisions
from service.store.decisions import Grounds
from service.web.answers.pages import go_to
from service.web.door.dependencies import OPERATE, IdentityDep, NamePath, RuntimeDep

router = APIRouter(include_in_schema=False)


class TakeForm(Model):
    """The button; ``reason`` says why, where somebody gave one."""

    reason: str = ""


@router.post("/heliostats/{name}/surfaces/{version}/take", dependencies=[OPERATE])
def post_take_form(
    name: NamePath,
    version: Annotated[Version, Path(description="Number of the version.")],
    form: Annotated[TakeForm, Form()],
    runtime: RuntimeDep,
    identity: IdentityDep,
) -> Response:
    """Make a version today's."""
    with runtime.database.writing() as session:
        heliostat = store.get_heliostat(session, name)
        surface = store.get_surface(session, heliostat, version)
        reason = form.reason[:200] or f"{identity.name} chose it"
        decisions.take(session, heliostat, surface, identity.name, Grounds(reason))
    return go_to(f"/heliostats/{name}#history-title")


@router.post("/heliostats/{name}/surfaces/{version}/seen", dependencies=[OPERATE])
def post_seen_form(
    name: NamePath,
    version: Annotated[Version, Path(description="Number of the version.")],
    runtime: RuntimeDep,
    identity: IdentityDep,
) -> Response:
    """Note that somebody has seen that a surface is not trusted."""
    with runtime.database.writing() as session:
        heliostat = store.get_heliostat(session, name)
        decisions.see(session, heliostat, store.get_surface(session, heliostat, version), identity.name)
    return go_to(f"/heliostats/{name}")


@router.post("/heliostats/{name}/surfaces/undo", dependencies=[OPERATE])
def post_undo_form(name: NamePath, runtime: RuntimeDep, identity: IdentityDep) -> Response:
    """Take the last decision back."""
    with runtime.database.writing() as session:
        decisions.undo(session, store.get_heliostat(session, name), identity.name)
    return go_to(f"/heliostats/{name}#history-title")
