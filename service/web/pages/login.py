"""The door's own page, and what it is made of; nothing here needs a key, and nothing shows the plant."""

import re
from http import HTTPStatus
from typing import Annotated

from fastapi import APIRouter, Form, Query, Request, Response
from fastapi.responses import HTMLResponse

from service.web.answers.pages import go_to, render
from service.web.door.dependencies import PresentedDep, RuntimeDep
from service.web.root.session import forget_key, is_valid, keep_key

router = APIRouter(include_in_schema=False)

# A path of this service and nothing that a browser could take for another host.
_OWN_PATH = re.compile(r"/(?:[A-Za-z0-9_-][A-Za-z0-9_/-]*)?(?:\?[A-Za-z0-9_=&.%-]*)?")


def own_path(wanted: str) -> str:
    """The path to go on to, or the field where somebody wrote another into the link."""
    return wanted if _OWN_PATH.fullmatch(wanted) else "/"


_WRONG = "This key is not valid: it may be mistyped or withdrawn. Try again, or ask for another."
_ENDED = "The key of this browser is not valid any more: it was withdrawn. Log in with another."


def _form(request: Request, next_: str, trouble: str = "") -> HTMLResponse:
    status = HTTPStatus.UNAUTHORIZED if trouble == _WRONG else HTTPStatus.OK
    return render(request, "login.html", status, next=own_path(next_), trouble=trouble)


@router.get("/login")
def get_login(
    request: Request,
    runtime: RuntimeDep,
    presented: PresentedDep,
    next_: Annotated[str, Query(alias="next", max_length=500)] = "/",
) -> HTMLResponse:
    """The form for a key; it says so where the one that the browser keeps opens nothing any more."""
    has_ended = presented is not None and not is_valid(runtime, presented)
    return _form(request, next_, _ENDED if has_ended else "")


@router.post("/login")
def post_login(
    key: Annotated[str, Form(max_length=200)],
    request: Request,
    runtime: RuntimeDep,
    next_: Annotated[str, Form(alias="next", max_length=500)] = "/",
) -> Response:
    """Keep a valid key in a cookie, and go on; the form again for any other."""
    if not is_valid(runtime, key.strip()):
        return _form(request, next_, _WRONG)
    answer = go_to(own_path(next_))
    keep_key(answer, request, key.strip())
    return answer


@router.post("/logout")
def post_logout() -> Response:
    """Forget the key."""
    answer = go_to("/login")
    forget_key(answer)
    return answer
