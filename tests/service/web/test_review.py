"""The queue that reviews photographs: accept, exclude, skip and undo."""

from typing import Any

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient

from tests.page import Page
from tests.service.conftest import Post, png
from tests.service.web.pages import HTML, make_key, text_of

QUEUE = "/photographs/review"


@pytest.fixture
def queue(client: TestClient, post: Post) -> TestClient:
    """Three photographs of three days, the newest one refused."""
    for day in (1, 2, 3):
        answer = post(png(day, refused=day == 3), id=f"{day}", taken_at=f"2024-06-0{day}T12:00:00Z")
        assert answer.status_code == 201
    return client


def press(client: TestClient, page: Page, action: str, **fields: str) -> Page:
    """Submit the form of a button, with what its hidden fields say."""
    button = page.one("button", data_key=action)
    form: Any = button.parent
    data = {one["name"]: one["value"] for one in form.all("input", type="hidden")}
    if "name" in button.attributes:
        data[button["name"]] = button["value"]
    answer = client.post(form["action"], data=data | fields, headers=HTML)
    assert answer.status_code == 200, answer.text
    return Page(answer.text)


def verdicts(client: TestClient) -> list[str | None]:
    items = client.get("/v1/heliostats/AA39/measurements").json()["items"]
    return [item["reason"] for item in items]


def test_photographs_are_accepted_excluded_skipped_and_undone(queue: TestClient):
    before = verdicts(queue)
    page = text_of(queue, QUEUE)
    assert "1 of 3" in page.words
    assert "refused" in page.one("h2", id="verdict-title").words
    assert not page.all("button", data_key="a")
    assert "open its page and correct the target" in page.words
    page = text_of(queue, page.one("a", data_key="s")["href"])
    assert "2 of 3" in page.words
    assert "forecasts it with an accuracy of" in page.words
    page = press(queue, page, "e", reason="clouds")
    assert "3 of 3" in page.words
    assert verdicts(queue) == [before[0], "excluded", before[2]]
    page = press(queue, page, "u")
    assert "2 of 3" in page.words
    assert verdicts(queue) == before
    page = press(queue, page, "a")
    assert "3 of 3" in page.words
    assert not page.all("button", data_key="u")
    (item, *_) = queue.get("/v1/audit").json()["items"]
    assert (item["action"], item["subject"]) == ("measurement.reviewed", "heliostat AA39 2")
    trail = text_of(queue, "/plant/audit")
    assert trail.one(title="measurement.reviewed").words == "Measurement reviewed"
    text_of(queue, trail.all("a", href="/heliostats/AA39/photographs/2")[0]["href"])
    page = press(queue, page, "a")
    assert "The end of the queue of 3" in page.words
    (correction, undone) = queue.get("/v1/heliostats/AA39/measurements/2/corrections").json()[
        "items"
    ]
    assert (correction["reason"], undone["reason"]) == ("clouds", "review undone")


def test_the_queue_has_the_filters_of_the_list(queue: TestClient):
    page = text_of(queue, "/photographs?verdict=used")
    link = page.one("a", href="/photographs/review?verdict=used")
    page = text_of(queue, link["href"])
    assert "1 of 2" in page.words
    page = press(queue, page, "e", reason="clouds")
    assert "1 of 1" in page.words
    page = text_of(queue, f"{QUEUE}?verdict=excluded")
    page = press(queue, page, "a")
    assert "excluded" not in verdicts(queue)
    assert "No photograph matches." in page.words
    assert "No photograph matches." in text_of(queue, f"{QUEUE}?target=upper").words


def test_a_refused_photograph_is_not_accepted_by_a_button(queue: TestClient):
    mark = (
        text_of(queue, QUEUE)
        .one("form", class_="inline", action=QUEUE)
        .one("input", name="at")["value"]
    )
    answer = queue.post(QUEUE, data={"at": mark, "action": "accept"}, headers=HTML)
    assert answer.status_code == 422
    assert "refused by its measurement" in answer.text
    assert queue.get(f"{QUEUE}?at=999", headers=HTML).status_code == 404
    assert queue.post(f"{QUEUE}/undo", data={"undo": "999"}, headers=HTML).status_code == 404


def test_a_reader_has_no_buttons(app: FastAPI, queue: TestClient):
    queue.headers["Authorization"] = f"Bearer {make_key(app, 'read')}"
    page = text_of(queue, f"{QUEUE}?verdict=used")
    assert not page.all("button", name="action")
    assert "need the role operate" in page.words
    refused = queue.post(QUEUE, data={"at": "1", "action": "exclude"}, headers=HTML)
    assert refused.status_code == 403
