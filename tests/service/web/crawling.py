"""All that can be reached by links from the first page."""

import re
from typing import NamedTuple
from urllib.parse import urldefrag

from fastapi.testclient import TestClient

from tests.page import Page


class Crawled(NamedTuple):
    """What pages lead to, and the status of what did not answer 200."""

    seen: set[str]
    refused: dict[str, int]


def links_of(text: str) -> set[str]:
    """Where a page's links lead, on this service."""
    followed = (
        urldefrag(one[name])[0]
        for one in Page(text).all()
        for name in ("href", "src", "hx-get")
        if name in one.attributes
    )
    return {link for link in followed if link.startswith("/")}


def figure_of(path: str) -> str:
    """The same for the same figure of pages of one kind."""
    page, _, query = path.partition("?")
    shown = [part for part in query.split("&") if part.startswith(("figure=", "format="))]
    return re.sub("[0-9]+", "", f"{page}?{'&'.join(shown)}")


def crawl(client: TestClient) -> Crawled:
    """Get every page and file; a figure of like pages once, for it is drawn for each."""
    waiting, seen, drawn, refused = ["/"], {"/"}, set[str](), {}
    while waiting:
        path = waiting.pop()
        if "figure=" in path and figure_of(path) in drawn:
            continue
        drawn.add(figure_of(path))
        answer = client.get(
            path, headers={"Accept": "text/html"} if not path.startswith("/v1/") else {}
        )
        if answer.status_code != 200:
            refused[path] = answer.status_code
        elif answer.headers["Content-Type"].startswith("text/html"):
            new = links_of(answer.text) - seen
            seen |= new
            waiting += sorted(new)
    return Crawled(seen, refused)
