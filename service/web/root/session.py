"""Sessions for pages, in a cookie, and the login page.

Scripts cannot read the cookie, and pages of other sites cannot use it. The login page needs no key
and shows nothing of the plant.
"""

import re
from datetime import timedelta
from http import HTTPStatus
from typing import Annotated

from fastapi import APIRouter, Form, HTTPException, Query, Request, Response, status
from fastapi.responses import HTMLResponse

from service.base.fields import Text
from service.store import audit, keys, sessions
from service.twin.runtime import Runtime
from service.web.auth import security
from service.web.auth.dependencies import PresentedDep, RuntimeDep
from service.web.responses.openapi import problems
from service.web.responses.pages import go_to, render

router = APIRouter(tags=["session"])


_HOUR = timedelta(hours=1)
# Refused logins of one address that the audit trail has of an hour, so that nobody can fill it.
_MAX_REFUSED = 20


def begin_session(runtime: Runtime, request: Request, key: str) -> str | None:
    """Begin a session with a key, and audit it; None if the key is not valid."""
    address = request.client.host if request.client else ""
    with runtime.database.reading() as session:
        is_known = keys.find(session, key) is not None
        refused = audit.count_recent(session, f"address {address}", _HOUR)
    if not is_known and refused >= _MAX_REFUSED:
        return None  # floods of wrong keys do not wait for the write lock
    with runtime.database.writing() as session:
        row = keys.find(session, key)
        if row is None:
            about = {"prefix": keys.prefix_of(key)}
            audit.record(session, keys.NOBODY, "session.refused", f"address {address}", **about)
            return None
        audit.record(session, row.name, "session.begun", f"key {row.name}", address=address)
        return sessions.begin(session, row)


def keep_session(response: Response, request: Request, token: str) -> None:
    """Store a session in the cookie of the browser."""
    response.set_cookie(
        security.COOKIE,
        token,
        max_age=int(sessions.LASTS.total_seconds()),
        httponly=True,
        samesite="strict",
        secure=request.url.scheme == "https",
    )


def end_session(runtime: Runtime, request: Request, response: Response) -> None:
    """End the session of the browser, and delete the cookie."""
    token = security.presented_session(request.headers)
    if token and security.identify(runtime.database, runtime.settings, token) is not None:
        with runtime.database.writing() as session:
            sessions.end(session, token)
    response.delete_cookie(security.COOKIE, httponly=True, samesite="strict")


@router.post(
    "/session",
    status_code=status.HTTP_204_NO_CONTENT,
    response_class=Response,
    responses=problems(401),
)
def post_session(
    key: Annotated[
        Text, Form(max_length=200, description="A key made by `heliotwin keys create`.")
    ],
    request: Request,
    runtime: RuntimeDep,
    response: Response,
) -> None:
    """Begin a session in a cookie. It lasts half a day, or until the key is withdrawn."""
    token = begin_session(runtime, request, key)
    if token is None:
        raise HTTPException(
            HTTPStatus.UNAUTHORIZED, "this key is not valid", {"WWW-Authenticate": "Bearer"}
        )
    keep_session(response, request, token)


@router.delete(
    "/session",
    status_code=status.HTTP_204_NO_CONTENT,
    response_class=Response,
    responses=problems(),
)
def delete_session(request: Request, runtime: RuntimeDep, response: Response) -> None:
    """End the session. Copies of its cookie are no longer valid."""
    end_session(runtime, request, response)


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


@router.get("/login", include_in_schema=False)
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


@router.post("/login", include_in_schema=False)
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


@router.post("/logout", include_in_schema=False)
def post_logout(request: Request, runtime: RuntimeDep) -> Response:
    """End the session."""
    answer = go_to("/login")
    end_session(runtime, request, answer)
    return answer
