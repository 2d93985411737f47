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
            real.run_job(client, "/v1/jobs/studies", candidates=[candidate])
            return client

        yield studied


def peaks_of_change(client: TestClient) -> tuple[list[float], list[float]]:
    """Peaks of forecasts [W/m2] before and after the adoption, on its page."""
    sheet = client.get("/studies/1/change?table=changes").text
    rows = list(csv.DictReader(sheet.splitlines()))
    before, after = (
        [float(row[f"Peak {when} [W/m²]"]) for row in rows] for when in ("before", "after")
    )
    return before, after


@pytest.mark.full
def test_an_effect_of_the_light_and_what_its_adoption_would_change(studied: Studied):
    client = studied(5, "sun_shape")
    # Nothing is open, so nothing must be confirmed.
    assert not text_of(client, "/studies/1").all("input", name="read")
    change = text_of(client, "/studies/1/change")
    assert "The flux stays the same" not in change
    before, after = peaks_of_change(client)
    assert len(before) == 2
    assert all(b < a for a, b in zip(before, after, strict=True))  # haze spreads the light
    assert client.post("/studies/1/adopt", data={}, follow_redirects=False).status_code == 303
    # The forecast is then what the page said.
    assert peaks_of_change(client)[0] == pytest.approx(after)


@pytest.mark.full
def test_nothing_missing_and_not_explained_have_nothing_to_adopt(studied: Studied):
    client = studied(2, "slope_error")
    for path in ("/studies/1", "/studies"):
        assert not text_of(client, path).all("form", action="/studies/1/adopt")
    assert "changes nothing" in client.get("/studies/1/change").json()["detail"]


@pytest.mark.full
def test_what_has_no_name_is_shown_adopted_as_no_cause_and_undone(studied: Studied):
    """A hazy sky, of which a study without the sun's shape says where it lives."""
    client = studied(5, "slope_error")
    study = client.get("/v1/studies/1").json()
    assert (study["verdict"], study["state"]) == ("unexplained", "candidate")
    found = study["discrepancy"]
    assert found["accuracy_after"] > study["before"]["accuracy_mean"] + 0.02
    assert {"name", "unit", "value", "ci95", "per"} < set(found["coefficients"][0])
    after = f"{100 * found['accuracy_after']:.1f} %"
    for path in ("/studies/1", "/studies/1/report"):
        card = text_of(client, path).one("section", aria_labelledby="discrepancy-title").words
        assert found["in_words"] in " ".join(card.split())
        assert after in card.replace("\xa0", " ")
        assert "Heliostats" in card  # by which the correction was left out
    assert set(study["partly"]) == {effect["name"] for effect in study["effects"]}
    assert study["adopts"] == ["correction (no cause)"]
    peaks = peaks_of_change(client)
    assert all(b < a for a, b in zip(*peaks, strict=True))  # haze spreads the light
    assert "Adopt correction (no cause)" in text_of(client, "/studies/1/change").words
    adopted = client.post("/v1/studies/1/adopt")
    assert adopted.status_code == 201, adopted.json()
    (effect,) = adopted.json()["effects"]
    assert effect["name"] == "correction"
    assert "2, correction (no cause)" in text_of(client, "/studies").words.replace(":", ",")
    assert peaks_of_change(client)[0] == pytest.approx(peaks[1])
    assert client.post("/v1/studies/1/withdraw").json()["effects"] == []
    assert peaks_of_change(client)[0] == pytest.approx(peaks[0])
    (first, second) = client.get("/v1/audit?limit=2").json()["items"]
    assert (first["action"], second["action"]) == ("effect.withdrawn", "effect.adopted")
    assert second["detail"]["effects"] == ["correction (no cause)"]


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
    answer = real_client.post("/v1/jobs/studies", json={"heliostats": ["AA39"], "images": 2})
    assert real.worker(real_client).work()
    page = text_of(real_client, f"/jobs/{answer.json()['id']}")
    assert "failed" in page
    assert "a study takes at least" in page
    assert len(real_client.get("/v1/studies").json()["items"]) == 1
