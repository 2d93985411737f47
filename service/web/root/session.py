"""A key in a cookie, for pages: scripts cannot read it, and no other site's page can use it."""

from http import HTTPStatus
from typing import Annotated

from fastapi import APIRouter, Form, HTTPException, Request, Response, status

from service.twin.runtime import Runtime
from service.web.answers.openapi import problems
from service.web.door import security
from service.web.door.dependencies import RuntimeDep

router = APIRouter(tags=["session"])

_LASTS_S = 12 * 3600


def is_valid(runtime: Runtime, key: str) -> bool:
    """Whether a key opens something."""
    return security.identify(runtime.database, runtime.settings, key) is not None


def keep_key(response: Response, request: Request, key: str) -> None:
    """Put a key into the browser's cookie for half a day."""
    secure = request.url.scheme == "https"
    response.set_cookie(security.COOKIE, key, max_age=_LASTS_S, httponly=True, samesite="strict", secure=secure)


def forget_key(response: Response) -> None:
    """Take the cookie back."""
    response.delete_cookie(security.COOKIE, httponly=True, samesite="strict")


@router.post("/session", status_code=status.HTTP_204_NO_CONTENT, response_class=Response, responses=problems(401))
def post_session(
    key: Annotated[str, Form(max_length=200, description="A key made by `heliotwin keys create`.")],
    request: Request,
    runtime: RuntimeDep,
    response: Response,
) -> None:
    """Keep a valid key in a cookie for half a day; it stops working at once when the key is withdrawn."""
    if not is_valid(runtime, key):
        raise HTTPException(HTTPStatus.UNAUTHORIZED, "this key is not valid", {"WWW-Authenticate": "Bearer"})
    keep_key(response, request, key)


@router.delete("/session", status_code=status.HTTP_204_NO_CONTENT, response_class=Response, responses=problems())
def delete_session(response: Response) -> None:
    """Forget the key."""
    forget_key(response)
