"""Times of many photographs from the browser: preview, storing, offset and undo."""

from typing import Any

import pytest
from fastapi.testclient import TestClient

from tests.service.conftest import Post, png
from tests.service.spots import photographs
from tests.service.web.pages import HTML, text_of

PATH = "/photographs/times"
REASON = "from the camera's log"


@pytest.fixture
def taken(client: TestClient, post: Post, tower: Any, properties: Any) -> list[dict[str, Any]]:
    """Three stored photographs of unknown time, with the times that they were taken at."""
    some = photographs(tower, properties)[:3]
    for number, one in enumerate(some):
        assert post(png(number), **one | {"taken_at": None}).status_code == 201
    return some


def _times(client: TestClient) -> list[str | None]:
    items = client.get("/v1/heliostats/AA39/measurements").json()["items"]
    return [item["taken_at"] for item in items]


def _preview(client: TestClient, lines: str, **files: Any) -> Any:
    return client.post(
        f"{PATH}/preview",
        data={"lines": lines, "reason": REASON},
        files=files or {"file": ("", b"")},
        headers=HTML,
    )


def test_times_are_previewed_stored_and_undone(client: TestClient, taken: list[dict[str, Any]]):
    assert "3\xa0photographs of 1 heliostat have no time" in text_of(client, PATH).words
    lines = "\n".join(f"AA39,{one['id']},{one['taken_at'][:-1]}" for one in taken)
    preview = _preview(client, lines)
    assert preview.status_code == 200, preview.text
    assert "Store 3 times" in preview.text
    assert _times(client) == [None] * 3
    stored = "\n".join(f"AA39,{one['id']},{one['taken_at']}" for one in taken)
    answer = client.post(PATH, data={"lines": stored, "reason": REASON}, headers=HTML)
    assert answer.status_code == 200
    assert _times(client) == [one["taken_at"] for one in taken]
    (item, *_) = client.get("/v1/audit").json()["items"]
    assert (item["action"], item["subject"]) == ("times.corrected", "3 photographs")
    undone = client.post(f"{PATH}/{item['id']}/undo", headers=HTML)
    assert "undone" in undone.text
    assert _times(client) == [None] * 3
    again = client.post(f"{PATH}/{item['id']}/undo", headers=HTML)
    assert again.status_code == 409
    history = client.get("/v1/heliostats/AA39/measurements/0/corrections").json()["items"]
    assert history[-1]["reason"] == f"undone: {REASON}"
    assert history[-1]["after"] == {"taken_at": None}


@pytest.mark.full
def test_an_undone_change_stays_so_while_alarms_are_undone(
    client: TestClient, taken: list[dict[str, Any]]
):
    lines = "\n".join(f"AA39,{one['id']},{one['taken_at']}" for one in taken)
    client.post(PATH, data={"lines": lines, "reason": REASON}, headers=HTML)
    number = client.get("/v1/audit").json()["items"][0]["id"]
    client.post(f"{PATH}/{number}/undo", headers=HTML)
    for _ in range(51):
        ids = [item["id"] for item in client.get("/v1/alarms").json()["items"][:1]]
        body = {"ids": ids, "reason": "known"}
        done = client.post("/v1/alarms/acknowledgements", json=body).json()["items"][0]
        client.post(f"/v1/alarms/acknowledgements/{done['acknowledgement']}/undo")
    assert f"{PATH}/{number}/undo" not in client.get(PATH, headers=HTML).text


def test_an_undo_keeps_what_was_corrected_since(client: TestClient, taken: list[dict[str, Any]]):
    lines = "\n".join(f"AA39,{one['id']},{one['taken_at']}" for one in taken)
    client.post(PATH, data={"lines": lines, "reason": REASON}, headers=HTML)
    number = client.get("/v1/audit").json()["items"][0]["id"]
    later = "2024-05-01T12:00:30Z"
    path = "/v1/heliostats/AA39/measurements/0"
    assert client.patch(path, json={"reason": "typing", "taken_at": later}).status_code == 200
    client.post(f"{PATH}/{number}/undo", headers=HTML)
    assert _times(client) == [later, None, None]


def test_an_offset_shifts_a_selection(client: TestClient, taken: list[dict[str, Any]]):
    lines = "\n".join(f"AA39,{one['id']},{one['taken_at']}" for one in taken)
    client.post(PATH, data={"lines": lines, "reason": REASON}, headers=HTML)
    form = {"minutes": "-60", "since": "2024-05-02", "until": "2024-05-02", "reason": REASON}
    shifted = client.post(f"{PATH}/shift", data=form, headers=HTML)
    assert "1 would change, " not in shifted.text
    assert "Store 1 time<" in shifted.text
    assert "2024-05-02 11:00" in shifted.text
    empty = client.post(f"{PATH}/shift", data=form | {"heliostat": "ZZ99"}, headers=HTML)
    assert empty.status_code == 404
    empty = client.post(f"{PATH}/shift", data=form | {"until": "2024-05-01"}, headers=HTML)
    assert "no photographs of a known time" in empty.text


def test_a_file_and_the_plants_zone(client: TestClient, tower: Any, taken: list[dict[str, Any]]):
    content = b"heliostat,id,taken_at\nAA39,0,2024-05-01T12:00:00+02:00\n"
    answer = _preview(client, "", file=("times.csv", content, "text/csv"))
    assert "2024-05-01 10:00" in answer.text
    contradicting = _preview(client, "AA39,0,2024-05-01T22:00:00")
    assert "The sun contradicts the time of 1." in contradicting.text


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        ("", "lines: holds no time"),
        ("a,b\n1,2", "needs the columns heliostat, id, taken_at"),
        ("AA39,0,20xx", "lines, line 1: taken_at"),
        ("AA39;0;2024-05-01T12:00:00", "lines, line 1: cells are separated by semicolons"),
        ("AA39\t0\t2024-05-01T12:00:00", "lines, line 1: cells are separated by tabs"),
        ("AA39,0,2024-05-01T12:00:00\n\nAA39,1,2024-05-01T12:00:00,5", "line 3: has 4 cells"),
        ("AA39,0,1781000000", "lines, line 1: taken_at: must be a time such as"),
        ("AA39,nothing,2024-05-01T12:00:00", "times.0: "),
        ("AA39,0,2999-05-01T12:00:00", "lies ahead of"),
    ],
)
def test_wrong_lines_are_named(client: TestClient, taken: Any, lines: str, said: str):
    answer = _preview(client, lines)
    assert answer.status_code == 422
    assert said in answer.text
    assert _times(client) == [None] * 3


def test_quoted_lines_and_comments_are_read(client: TestClient, taken: Any):
    lines = '# from the log\n"heliostat","id","taken_at"\n"AA39","0","2024-05-01 12:00:00.5"\n'
    assert "2024-05-01 12:00 UTC" in _preview(client, lines).text


def test_undated_photographs_are_a_group_at_the_end(client: TestClient, post: Post, taken: Any):
    assert post(png(9), id="dated", taken_at="2024-06-01T12:00:00Z").status_code == 201
    rows = text_of(client, "/photographs").one("table", id="photographs").all("tr")[1:]
    assert [row.words == "Time unknown" for row in rows] == [False, True, False, False, False]
    assert "dated" in rows[0].words


def test_motor_positions_are_previewed_stored_and_undone(client: TestClient, post: Post):
    assert post(png(1), id="1").status_code == 201
    path = "/v1/heliostats/AA39/measurements/1"
    form = {"lines": "AA39,1,30076,37935", "what": "motors", "reason": "from the drives' log"}
    preview = client.post(f"{PATH}/preview", data=form, files={"file": ("", b"")}, headers=HTML)
    assert "Store 1 motor position<" in preview.text
    assert client.get(path).json()["motor_position"] is None
    client.post(PATH, data=form, headers=HTML)
    assert client.get(path).json()["motor_position"] == [30076, 37935]
    number = client.get("/v1/audit").json()["items"][0]["id"]
    assert client.post(f"{PATH}/{number}/undo", headers=HTML).status_code == 200
    assert client.get(path).json()["motor_position"] is None
    wrong = form | {"lines": "AA39,1,30076,x"}
    refused = client.post(f"{PATH}/preview", data=wrong, files={"file": ("", b"")}, headers=HTML)
    assert refused.status_code == 422
    assert "lines" in refused.text
