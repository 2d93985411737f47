"""A storm of 200 alarms is reduced to its causes, over REST and on the page."""

import re
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from heliotwin.demo.field import write_layout
from service.base.settings import Settings
from service.sources.folder import read_folder
from service.twin.alarms.alarms import Alarm
from service.twin.alarms.common_causes import find_bursts
from service.twin.importing import import_folder
from service.web.app import create_app
from tests.service.conftest import (
    QUIET,
    FakeOperations,
    client_of,
    png,
    poster,
    properties_document,
    tower_document,
)
from tests.service.storm import CLOCK, UNDATED, make_storm, storm_app
from tests.service.web.test_alarms import Blind, recent

HTML = {"Accept": "text/html"}
PATH = "/v1/alarms"


@pytest.mark.full
def test_storm_is_reduced_to_its_causes(tmp_path: Path):
    app = storm_app(tmp_path)
    make_storm(app, tmp_path)
    with client_of(app) as client:
        assert len(client.get(PATH, params={"limit": 500}).json()["items"]) == 200
        assert client.get("/alarms/count").text.startswith('<span class="count">200<')
        clock, undated = client.get(f"{PATH}/causes").json()["items"]
        assert clock["alarms"] == {"sun_contradicts_time": CLOCK}
        assert clock["evidence"][0].startswith("a clock 1 h ahead explains it")
        assert "all photographs were sent by local" in clock["evidence"]
        assert (len(clock["ids"]), len(clock["heliostats"])) == (CLOCK, CLOCK)
        assert undated["alarms"] == {"times_unknown": UNDATED}
        page = client.get("/alarms", headers=HTML).text
        assert "2 probable causes of 199 alarms, and 1 other" in page
        assert len(page) < 500_000
        links = r'href="(/photographs(?:/review)?)[?]heliostat=(\S+)&amp;warned=true"'
        listed, reviewed = re.findall(links, page)[:2]
        assert (listed[0], reviewed[0]) == ("/photographs", "/photographs/review")
        for path, name in (listed, reviewed):
            asked = {"heliostat": name, "warned": True}
            assert client.get(path, params=asked, headers=HTML).status_code == 200
        # As one on the page, the other over REST.
        token = re.findall(r'name="groups" value="(cause:\S+)"', page)[0]
        form = {"groups": token, "why": "Work is ordered", "words": "the clock is being set"}
        page = client.post("/alarms/acknowledgements", data=form, headers=HTML).text
        assert f"{CLOCK} acknowledged by local: Work is ordered: the clock is being set" in page
        assert client.post("/alarms/acknowledgements", data=form, headers=HTML).status_code == 409
        body = {"ids": undated["ids"], "reason": "times follow"}
        assert client.post(f"{PATH}/acknowledgements", json=body).status_code == 200
        (left,) = client.get(PATH, params={"acknowledged": False}).json()["items"]
        assert (left["reason"], left["severity"]) == ("queue", 1)
        assert client.get(f"{PATH}/causes").json()["items"] == []
        history = client.get(f"{PATH}/history", params={"limit": 500}).json()["items"]
        assert len(history) == 200
        assert 'severity="2"} 187.0' in client.get("/metrics").text


def alarms(*days: float) -> list[Alarm]:
    begin = datetime(2026, 1, 1, tzinfo=UTC)
    return [
        Alarm("accuracy", f"H{k}", begin + timedelta(days=day), "", "", "")
        for k, day in enumerate(days)
    ]


def test_bursts_are_more_than_the_usual_number():
    assert find_bursts(alarms(1, 1.1, 1.2, 1.3)) == []  # too few
    together = [10 + k / 100 for k in range(12)]
    (burst,) = find_bursts(alarms(1, 2, 3, *together, 20, 30))
    assert len(burst) == 12
    assert find_bursts(alarms(*(k / 5 for k in range(300)))) == []  # five on every day
    assert len(find_bursts(alarms(*together, *(day + 40 for day in together)))) == 2


@pytest.mark.full
def test_evidence_of_what_photographs_have_in_common(tmp_path: Path):
    """All that were photographed in a windy hour are forecast poorly."""
    app = create_app(Settings(data_dir=tmp_path, **QUIET), Blind())
    with client_of(app) as client:
        client.put("/v1/plant", json=tower_document())
        for number in range(6):
            client.put(f"/v1/heliostats/H{number}", json=properties_document())
            about = recent() | {"wind_speed_m_s": 12.0}
            poster(client)(png(number), f"H{number}", **recent())
            made = client.post(f"/v1/heliostats/H{number}/surfaces", json={"method": "network"})
            assert made.status_code == 201
            poster(client)(png(number + 10), f"H{number}", **about)
        (cause,) = client.get(f"{PATH}/causes").json()["items"]
        assert cause["alarms"] == {"accuracy": 6}
        assert cause["evidence"] == [
            "6 of 6 heliostats that were photographed at that time are affected, as by haze or a"
            " camera",
            "all photographs were taken on lower",
            "the wind was 12 m/s",
        ]


def test_evidence_that_a_field_was_added_and_not_photographed(tmp_path: Path):
    settings = Settings(data_dir=tmp_path / "data", **QUIET, alarm_photograph_days=1e-7)
    app = create_app(settings, FakeOperations())
    with client_of(app) as client:
        plant = write_layout(tmp_path / "plant", 1)
        folder = read_folder(tmp_path / "plant", [], whole_field=True)
        import_folder(app.state.runtime, folder)
        (cause,) = client.get(f"{PATH}/causes").json()["items"]
        assert cause["alarms"] == {"no_photograph": len(plant.heliostats)}
        assert cause["evidence"][0] == "no photograph with a known time was ever accepted"
        assert cause["evidence"][1].startswith("the heliostats were added at ")
