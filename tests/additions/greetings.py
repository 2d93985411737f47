"""A REST resource."""

from fastapi import APIRouter

from service.web.auth.dependencies import READ

router = APIRouter(prefix="/greetings", tags=["health"])


@router.get("", dependencies=[READ])
def list_greetings() -> list[str]:
    return ["hello"]
