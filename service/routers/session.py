"""A key in a cookie, for pages: scripts cannot read it, and no other site's page can use it."""

from http import HTTPStatus
from typing import Annotated

from fastapi import APIRouter, Form, HTTPException, Request, Response, status

from service import security
from service.dependencies import RuntimeDep
from service.openapi import problems

router = APIRouter(tags=["session"])

_LASTS_S = 12 * 3600


@router.post("/session", status_code=status.HTTP_204_NO_CONTENT, responses=problems(413))
def post_session(
    key: Annotated[str, Form(max_length=200, description="A key made by `heliotwin keys create`.")],
    request: Request,
    runtime: RuntimeDep,
    response: Response,
) -> None:
    """Keep a valid key in a cookie for half a day; it stops working at once when the key is withdrawn."""
    if security.identify(runtime.database, runtime.settings, key) is None:
        raise HTTPException(HTTPStatus.UNAUTHORIZED, "this key is not valid", {"WWW-Authenticate": "Bearer"})
    response.set_cookie(
        security.COOKIE, key, max_age=_LASTS_S, httponly=True, samesite="strict", secure=request.url.scheme == "https"
    )


@router.delete("/session", status_code=status.HTTP_204_NO_CONTENT, responses=problems())
def delete_session(response: Response) -> None:
    """Forget the key."""
    response.delete_cookie(security.COOKIE, httponly=True, samesite="strict")
