"""A page."""

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse

from service.web.auth.dependencies import READ
from service.web.responses.pages import render

router = APIRouter(include_in_schema=False)


@router.get("/hello", dependencies=[READ])
def get_hello_page(request: Request) -> HTMLResponse:
    return render(request, "alert.html", problem={"title": "Hello", "detail": "a page"})
