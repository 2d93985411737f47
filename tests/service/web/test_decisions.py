"""Which surface is active: the better one, unless a person decides otherwise.

Such a decision can be undone.
"""

from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient

from model.observation import Observation, SurfacePrediction
from model.plant import Heliostat
from service import store
from service.base.settings import Settings
from service.twin.surfaces.prediction import import_surface
from service.web.app import create_app
from tests.page import Page
from tests.service.conftest import (
    QUIET,
    FakeOperations,
    client_of,
    png,
    poster,
    properties_document,
    sun_at,
    tower_document,
)
from tests.service.web.pages import work

BASE = "/v1/heliostats/AA39/surfaces"


class Mirrors(FakeOperations):
    """Predicts a mirror that bends by ``bends`` of the method [mm], and forecasts the worse the
    more a mirror bends.
    """

    bends: dict[str, float]

    def __init__(self) -> None:
        super().__init__()
        self.bends = {"network": 2.0, "refined": 1.0}
        self.warnings: tuple[str, ...] = ()

    def predict(self, heliostat: Heliostat, *rest: Any, **more: Any) -> SurfacePrediction:
        made = super().predict(heliostat, *rest, **more)
        z = np.full((4, 8, 8), self.bends[made.method] / 1e3)
        return replace(made, z=z, warnings=self.warnings)

    def render(
        self, heliostat: Heliostat, observations: list[Observation], z: Any, *rest: Any, **more: Any
    ) -> Any:
        right = super().render(heliostat, observations, z, *rest, **more)
        wrong = np.zeros_like(right)
        wrong[:, 0, 0] = 100
        share = 1 if z is None else np.clip(np.abs(z).max() * 50, 0, 1)
        return (1 - share) * right + share * wrong


@pytest.fixture
def mirrors() -> Mirrors:
    return Mirrors()


@pytest.fixture
def client(tmp_path: Path, mirrors: Mirrors) -> Iterator[TestClient]:
    with client_of(create_app(Settings(data_dir=tmp_path, **QUIET), mirrors)) as client:
        client.put("/v1/plant", json=tower_document())
        client.put("/v1/heliostats/AA39", json=properties_document())
        photograph(client, 0, 1, 2)
        yield client


def photograph(client: TestClient, *numbers: int) -> None:
    """Post photographs of these numbers, each on its day of May."""
    for number in numbers:
        sent = {
            "id": str(number),
            "sun": sun_at(180 - 10.0 * number),
            "taken_at": f"2024-05-0{number + 1}T10:00:00Z",
        }
        assert poster(client)(png(number), **sent).status_code == 201


def predict(client: TestClient, method: str, *measurements: str) -> Any:
    answer = client.post(
        BASE, json={"method": method, "measurements": measurements or ("0", "1", "2")}
    )
    assert answer.status_code == 201, answer.text
    return answer.json()


def current(client: TestClient) -> int:
    return int(client.get(f"{BASE}/current").json()["version"])


def test_worse_surface_waits_aside(client: TestClient):
    assert predict(client, "refined")["is_candidate"] is False
    assert predict(client, "network")["is_candidate"] is True
    assert current(client) == 1
    (decision,) = client.get(f"{BASE}/decisions").json()["items"]
    assert (decision["version"], decision["became_active"], decision["previous"]) == (2, False, 1)
    assert decision["accuracy_before"] == pytest.approx(0.9, abs=0.01)
    assert decision["accuracy_after"] == pytest.approx(0.8, abs=0.01)
    assert "too few to judge" in decision["reason"]
    assert "version 1 is refined, this one is the network's alone" in decision["reason"]


def test_better_surface_becomes_active_and_is_undone(client: TestClient):
    predict(client, "network")
    assert predict(client, "refined")["is_candidate"] is False
    assert current(client) == 2
    undone = client.post(f"{BASE}/undo")
    assert (undone.status_code, undone.json()["version"], current(client)) == (200, 1, 1)
    assert client.get(f"{BASE}/2").json()["is_candidate"] is True
    assert client.post(f"{BASE}/undo").status_code == 200  # undone again it is as it was
    assert current(client) == 2
    assert client.get(f"{BASE}/2").json()["is_candidate"] is False


@pytest.mark.full
def test_undo_is_of_the_last_decision_that_changed_the_active_surface(
    client: TestClient, mirrors: Mirrors
):
    """Later candidates do not count: they changed nothing."""
    predict(client, "network")
    predict(client, "refined")
    mirrors.bends["network"] = 3.0
    assert predict(client, "network")["is_candidate"] is True
    client.put(
        f"{BASE}/current", json={"version": 2, "reason": "it stays"}
    )  # nor of what left it in its place
    assert "Undo: back to version 1" in page_of(client, "/heliostats/AA39")
    undone = client.post(f"{BASE}/undo")
    assert (undone.status_code, undone.json()["previous"], current(client)) == (200, 2, 1)
    assert "Undo: back to version 2" in page_of(client, "/heliostats/AA39")
    assert client.get(f"{BASE}/3").json()["is_candidate"] is True


def test_what_came_since_is_not_undone(client: TestClient):
    """A measured surface becomes active without a decision.

    So no decision names the surface that was active before it.
    """
    predict(client, "network")
    predict(client, "refined")
    measure(client, 4e-3)
    assert current(client) == 3
    assert client.post(f"{BASE}/undo").status_code == 409
    assert "Undo: back" not in page_of(client, "/heliostats/AA39")
    assert current(client) == 3


def test_somebody_decides_otherwise(client: TestClient):
    predict(client, "refined")
    predict(client, "network")
    chosen = client.put(f"{BASE}/current", json={"version": 2, "reason": "the mirror was cleaned"})
    assert (chosen.status_code, current(client)) == (200, 2)
    assert (
        client.put(f"{BASE}/current", json={"version": 1, "reason": "no"}).json()["previous"] == 2
    )
    assert (current(client), client.get(f"{BASE}/2").json()["is_candidate"]) == (1, True)
    client.post(f"{BASE}/undo")
    assert current(client) == 2
    assert client.put(f"{BASE}/current", json={"version": 9, "reason": "x"}).status_code == 404
    assert client.put(f"{BASE}/current", json={"version": 1}).status_code == 422
    actions = [entry["action"] for entry in client.get("/v1/audit").json()["items"]]
    assert actions[:4] == [
        "surface.promoted",
        "surface.promoted",
        "surface.promoted",
        "surface.rejected",
    ]


def test_nothing_to_undo(client: TestClient):
    predict(client, "refined")
    answer = client.post(f"{BASE}/undo")
    assert answer.status_code == 409
    assert "choose a version" in answer.json()["detail"]


def test_photographs_that_neither_has_seen_judge(client: TestClient, mirrors: Mirrors):
    photograph(client, 3, 4, 5, 6)
    predict(client, "refined", "0")
    mirrors.bends["network"] = 0.0
    predict(client, "network", "1")
    (decision,) = client.get(f"{BASE}/decisions").json()["items"]
    assert (decision["photographs"], decision["became_active"]) == (5, True)
    assert (
        "forecasts better than version 1 on 5 photographs that neither has seen, by"
        in decision["reason"]
    )


def test_a_few_unseen_photographs_judge_nothing(client: TestClient, mirrors: Mirrors):
    """One alone would have put the network's surface in the refined one's place."""
    predict(client, "refined", "0")
    mirrors.bends["network"] = 0.0
    assert predict(client, "network", "1")["is_candidate"] is True
    reason = client.get(f"{BASE}/decisions").json()["items"][0]["reason"]
    assert "too few to judge (5 do)" in reason


def test_surface_of_corrected_photographs_gives_way(client: TestClient):
    """A surface made again from the corrected photographs replaces it.

    That the wrong one forecasts them better does not matter.
    """
    predict(client, "refined")
    sent = {"reason": "the clock was wrong", "sun": sun_at(121.0)}
    assert client.patch("/v1/heliostats/AA39/measurements/2", json=sent).status_code == 200
    assert predict(client, "network")["is_candidate"] is False
    assert (
        "corrected or deleted since" in client.get(f"{BASE}/decisions").json()["items"][0]["reason"]
    )


def test_measured_surface_stays_unless_unseen_photographs_speak(
    client: TestClient, mirrors: Mirrors
):
    photograph(client, 3)
    measure(client, 5e-3, datetime(1970, 1, 1, tzinfo=UTC))
    assert predict(client, "refined")["is_candidate"] is True  # four photographs are too few
    assert "version 1 was measured" in client.get(f"{BASE}/decisions").json()["items"][0]["reason"]
    photograph(client, 4, 5, 6)
    mirrors.warnings = ("a facet sends no light",)
    assert predict(client, "refined", "5")["is_candidate"] is True
    assert (
        "only a person may promote it"
        in client.get(f"{BASE}/decisions").json()["items"][0]["reason"]
    )
    mirrors.warnings = ()
    assert predict(client, "refined", "2")["is_candidate"] is False
    assert current(client) == 4


def test_nothing_new_makes_no_version(client: TestClient):
    first = predict(client, "refined")
    again = client.post(BASE, json={"method": "refined", "measurements": ["0", "1", "2"]})
    assert (again.status_code, again.json()) == (200, first)
    assert again.headers["Location"] == f"{BASE}/1"
    assert len(client.get(BASE).json()["items"]) == 1


def test_surface_of_earlier_photographs_is_history(client: TestClient):
    """It replaces nothing, so nothing is judged."""
    predict(client, "network", "2")
    assert predict(client, "refined", "0")["is_candidate"] is False
    assert current(client) == 1
    assert client.get(f"{BASE}/decisions").json()["items"] == []


def measure(client: TestClient, bend_m: float, valid_from: datetime | None = None) -> None:
    """Store a surface that was measured: it bends by so much."""
    app: Any = client.app
    with app.state.runtime.database.writing() as session:
        z = np.full((4, 8, 8), bend_m)
        new = store.NewSurface(
            "measured", z, 0 * z, np.stack([z] * 3, -1), valid_from or datetime.now(UTC)
        )
        store.add_surface(session, store.get_heliostat(session, "AA39"), new)


def page_of(client: TestClient, path: str) -> str:
    return str(client.get(path, headers={"Accept": "text/html"}).text)


def test_cancelled_job_says_what_it_changed(
    client: TestClient, mirrors: Mirrors, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("service.jobs.kind._REPORT_EVERY_S", 0.0)
    app: Any = client.app
    client.put("/v1/heliostats/AB01", json=properties_document())
    poster(client)(png(7), heliostat="AB01")
    predict(client, "refined")
    asked = client.post("/v1/jobs/predictions", json={"method": "network"}).json()["id"]
    predicted = mirrors.predict

    def cancelling(heliostat: Heliostat, *rest: Any, **more: Any) -> Any:
        if heliostat.name == "AB01":
            client.post(f"/v1/jobs/{asked}/cancel")
        return predicted(heliostat, *rest, **more)

    mirrors.predict = cancelling  # type: ignore[method-assign]
    for name in ("AB02", "AB03"):
        client.put(f"/v1/heliostats/{name}", json=properties_document())
    work(app)
    job = client.get(f"/v1/jobs/{asked}").json()
    assert job["state"] == "cancelled"
    assert job["result"]["surfaces"]["AA39"] == 2
    assert job["result"]["judged"]["AA39"]["became_active"] is False
    page = page_of(client, f"/jobs/{asked}")
    assert "Changes until it ended" in page
    assert "AA39, version 2" in page
    assert '<span class="state">candidate</span>' in page


def test_page_decides_and_takes_back(client: TestClient):
    predict(client, "network")
    predict(client, "refined")
    page = page_of(client, "/heliostats/AA39")
    assert "80.0\N{NO-BREAK SPACE}% before, <strong>90.0" in page
    assert "Undo: back to version 1" in page
    assert client.post("/heliostats/AA39/surfaces/undo", follow_redirects=False).status_code == 303
    assert current(client) == 1
    page = page_of(client, "/heliostats/AA39")
    assert 'action="/heliostats/AA39/surfaces/2/take"' in page
    client.post("/heliostats/AA39/surfaces/2/take", data={}, follow_redirects=False)
    assert current(client) == 2


def test_photographs_are_excluded_with_a_reason_and_used_again(
    client: TestClient, mirrors: Mirrors
):
    mirrors.warnings = ("photograph 2 is not explained",)
    predict(client, "network")
    client.get("/v1/alarms")  # the state of the field is written
    page = Page(page_of(client, "/heliostats/AA39"))
    sent = {"photographs": ["1", "2"], "reason": "a cloud"}
    path = "/heliostats/AA39/exclusions"
    assert page.one("h2", id="causes-title").words == "Why is it bad"
    causes = client.get("/v1/heliostats/AA39/causes").json()
    assert not causes["pending"]
    assert causes["items"]
    for cause in causes["items"]:
        assert f"{cause['label']}" in page.words
        assert cause["evidence"] in page.words
    assert client.post(path, data={"photographs": ["1"]}).status_code == 422
    answer = client.post(path, data=sent, follow_redirects=False)
    assert (answer.status_code, answer.headers["location"][-15:]) == (303, "#excluded-title")
    excluded = Page(page_of(client, "/heliostats/AA39"))
    assert excluded.words.count(": a cloud.") == 2
    again = {"photographs": ["1"], "reason": "took back: a cloud", "excluded": "false"}
    assert client.post(path, data=again, follow_redirects=False).status_code == 303
    kept = client.get("/v1/heliostats/AA39/measurements/1").json()
    assert (kept["accepted"], kept["reason"]) == (True, None)
    job = client.post(path, data=sent | {"photographs": ["1"], "predict_again": "true"})
    assert job.url.path.startswith("/jobs/")


def test_candidate_is_kept_or_promoted_with_a_reason(client: TestClient):
    predict(client, "refined")
    predict(client, "network")
    page = Page(page_of(client, "/heliostats/AA39"))
    assert page.one("h2", id="decide-title").words == "Candidate 2 or version 1"
    assert "on the same 3 photographs for both: 90.0" in page.words
    path, reason = "/heliostats/AA39/surfaces/2", {"reason": "no better"}
    assert client.post(f"{path}/keep", data=reason, follow_redirects=False).status_code == 303
    kept = Page(page_of(client, "/heliostats/AA39"))
    assert not kept.all("h2", id="decide-title")
    assert "version 2 is a candidate. No better" in kept.words
    assert "/heliostats/AA39?candidate=2#decide-title" in kept.links
    reason = {"reason": "cleaner photographs"}
    again = Page(page_of(client, "/heliostats/AA39?candidate=2"))
    assert f"{path}/take" in again.links
    assert client.post(f"{path}/take", data=reason, follow_redirects=False).status_code == 303
    assert current(client) == 2
    assert client.post(f"{path}/keep", data=reason).status_code == 409
    assert "Undo: back to version 1" in page_of(client, "/heliostats/AA39")


def test_choosing_by_hand_has_the_figures_of_the_last_comparison(client: TestClient):
    """Fewer than five photographs are unseen, so parts of the surfaces judged each other."""
    predict(client, "refined")
    predict(client, "network")
    (judged,) = client.get(f"{BASE}/decisions").json()["items"]
    names = ("accuracy_before", "accuracy_after", "photographs")
    headers = {"If-Match": client.get(f"{BASE}/current").headers["ETag"]}
    for version, sign in ((2, 1), (1, -1)):
        chosen = client.put(
            f"{BASE}/current", json={"version": version, "reason": "to try"}, headers=headers
        ).json()
        assert [chosen[name] for name in names] == [
            *(judged[name] for name in names[:2][::sign]),
            judged["photographs"],
        ]
        headers = {"If-Match": client.get(f"{BASE}/current").headers["ETag"]}


def test_imported_surface_is_judged_by_photographs(client: TestClient):
    """It forecasts worse than the active one on five photographs that neither has seen."""
    runtime = client.app.state.runtime  # type: ignore[attr-defined]
    photograph(client, 3, 4, 5, 6, 7)
    predict(client, "network")
    for bend, is_candidate in ((15e-3, True), (1e-3, False)):
        z = np.full((4, 8, 8), bend)
        new = store.NewSurface("measured", z, 0 * z, np.full((4, 8, 8, 3), bend))
        assert import_surface(runtime, "AA39", new, "tester")
        assert not import_surface(runtime, "AA39", new, "tester")
        newest = client.get(BASE).json()["items"][-1]
        assert (newest["source"], newest["is_candidate"]) == ("measured", is_candidate)
    decisions = client.get(f"{BASE}/decisions").json()["items"]
    assert [one["became_active"] for one in decisions] == [True, False]
    assert all("on 5 photographs that neither has seen" in one["reason"] for one in decisions)
    assert current(client) == 3
