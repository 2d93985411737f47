"""Results of small real studies as pages, of every verdict; what their adoption would change."""

import csv
import shutil
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from fastapi.testclient import TestClient

from tests.service import real
from tests.service.web.pages import text_of

Studied = Callable[[int, str], TestClient]


@pytest.fixture
def studied(undeclared: Path, tmp_path: Path) -> Iterator[Studied]:
    """A function that imports two heliostats of a set with an unknown effect, and studies them."""
    with ExitStack() as stack:

        def studied(number: int, candidate: str) -> TestClient:
            source, folder = undeclared / f"set-{number}", tmp_path / "import" / "set"
            folder.mkdir(parents=True)
            for path in source.glob("*.json"):
                shutil.copy(path, folder)
            for path in sorted(path for path in source.iterdir() if path.is_dir())[::3]:
                shutil.copytree(path, folder / path.name)
            client = stack.enter_context(real.client_on(tmp_path))
            real.run_job(client, "/v1/jobs/imports", folder="set")
            real.run_job(client, "/v1/studies", candidates=[candidate])
            return client

        yield studied


def test_an_effect_of_the_light_and_what_its_adoption_would_change(studied: Studied):
    client = studied(1, "slope_error")
    # Nothing is open, so nothing must be confirmed.
    assert not text_of(client, "/studies/1").all("input", name="read")
    change = text_of(client, "/studies/1/change")
    assert "The flux stays the same" not in change
    sheet = client.get("/studies/1/change?table=changes").text
    rows = list(csv.DictReader(sheet.splitlines()))
    assert [row["Heliostat"] for row in rows] == ["AA38", "AU18"]
    before, after = (
        [float(row[f"Peak {when} [W/m²]"]) for row in rows] for when in ("before", "after")
    )
    assert all(b < a for a, b in zip(before, after, strict=True))  # rough mirrors spread the light
    assert client.post("/studies/1/adopt", data={}, follow_redirects=False).status_code == 303
    # The forecast is then what the page said.
    again = client.get("/studies/1/change?table=changes").text
    forecast = [float(row["Peak before [W/m²]"]) for row in csv.DictReader(again.splitlines())]
    assert forecast == pytest.approx(after)


@pytest.mark.full
def test_nothing_missing_and_not_explained_have_nothing_to_adopt(studied: Studied):
    client = studied(2, "slope_error")
    for path in ("/studies/1", "/studies"):
        assert not text_of(client, path).all("form", action="/studies/1/adopt")
    assert "changes nothing" in client.get("/studies/1/change").json()["detail"]


@pytest.mark.full
def test_not_explained(studied: Studied):
    client = studied(3, "sun_shape")
    assert client.get("/v1/studies/1").json()["state"] == "nothing_to_adopt"


def test_accuracies_over_time(real_client: TestClient):
    """Times that are given after a study count, because they are read when the page is shown."""
    assert not text_of(real_client, "/studies/1").all("figure", class_="timeline")
    keys = list(real_client.get("/v1/studies/1").json()["before"]["per_image"])
    times = [
        {
            "heliostat": key.partition("/")[0],
            "id": key.partition("/")[2],
            "taken_at": f"2024-06-{number + 1:02}T10:00:00Z",
        }
        for number, key in enumerate(keys[1:])
    ]
    body = {"reason": "the log of the camera", "times": times}
    assert real_client.patch("/v1/measurements/times", json=body).status_code == 200
    page = text_of(real_client, "/studies/1")
    (chart,) = page.all("figure", class_="timeline")
    assert "before: 4 values" in chart.words
    assert "after: 4 values" in chart.words
    assert "Time unknown, so not drawn: 1 of before" in chart.words
    sheet = real_client.get("/studies/1?figure=timeline-1&format=csv").text
    assert sheet.count("2024-06-") == 8


def test_too_few_photographs_end_the_job_with_the_reason(real_client: TestClient):
    answer = real_client.post("/v1/studies", json={"heliostats": ["AA39"], "images": 2})
    assert real.worker(real_client).work()
    page = text_of(real_client, f"/jobs/{answer.json()['id']}")
    assert "failed" in page
    assert "a study takes at least" in page
    assert len(real_client.get("/v1/studies").json()["items"]) == 1
