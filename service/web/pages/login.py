"""The login page. It needs no key and shows nothing of the plant."""

import re
from http import HTTPStatus
from typing import Annotated

from fastapi import APIRouter, Form, Query, Request, Response
from fastapi.responses import HTMLResponse

from service.base.fields import Text
from service.web.auth import security
from service.web.auth.dependencies import PresentedDep, RuntimeDep
from service.web.responses.pages import go_to, render
from service.web.root.session import begin_session, end_session, keep_session

router = APIRouter(include_in_schema=False)

# A path of this service, and nothing that a browser could read as another host.
_OWN_PATH = re.compile(r"/(?:[A-Za-z0-9_-][A-Za-z0-9_/-]*)?(?:\?[A-Za-z0-9_=&.%-]*)?")


def own_path(wanted: str) -> str:
    """The path to continue to, or the field page if the link holds anything else."""
    return wanted if _OWN_PATH.fullmatch(wanted) else "/"


_WRONG = "This key is not valid: it may be mistyped, expired or withdrawn. Ask for another."
_ENDED = (
    "The session of this browser has ended: its time is over, or that of its key. Log in again."
)


def _form(request: Request, next_: str, trouble: str = "") -> HTMLResponse:
    page = render(request, "login.html", next=own_path(next_), trouble=trouble)
    page.status_code = HTTPStatus.UNAUTHORIZED if trouble == _WRONG else HTTPStatus.OK
    return page


@router.get("/login")
def get_login(
    request: Request,
    runtime: RuntimeDep,
    presented: PresentedDep,
    next_: Annotated[Text, Query(alias="next")] = "/",
) -> HTMLResponse:
    """The login form. It says so if the session of the browser is no longer valid."""
    has_ended = (
        presented is not None
        and security.identify(runtime.database, runtime.settings, presented) is None
    )
    return _form(request, next_, _ENDED if has_ended else "")


@router.post("/login")
def post_login(
    key: Annotated[Text, Form(max_length=200)],
    request: Request,
    runtime: RuntimeDep,
    next_: Annotated[Text, Form(alias="next")] = "/",
) -> Response:
    """Begin a session with a valid key and continue; otherwise show the form again."""
    token = begin_session(runtime, request, key.strip())
    if token is None:
        return _form(request, next_, _WRONG)
    answer = go_to(own_path(next_))
    keep_session(answer, request, token)
    return answer


@router.post("/logout")
def post_logout(request: Request, runtime: RuntimeDep) -> Response:
    """End the session."""
    answer = go_to("/login")
    end_session(runtime, request, answer)
    return answer
