"""A storm of 200 alarms is reduced to its causes, over REST and on the page."""

import re
from datetime import UTC, datetime, timedelta
from pathlib import Path

from service.twin.alerts.alerts import Alert
from service.twin.alerts.common_causes import find_bursts
from tests.service.conftest import client_of
from tests.service.storm import CLOCK, UNDATED, make_storm, storm_app

HTML = {"Accept": "text/html"}
PATH = "/v1/attention"


def test_storm_is_reduced_to_its_causes(tmp_path: Path):
    app = storm_app(tmp_path)
    make_storm(app, tmp_path)
    with client_of(app) as client:
        assert len(client.get(PATH, params={"limit": 500}).json()["items"]) == 200
        assert client.get("/attention/count").text.startswith('<span class="count">200<')
        clock, undated = client.get(f"{PATH}/causes").json()["items"]
        assert clock["alerts"] == {"sun_contradicts_time": CLOCK}
        assert clock["evidence"][0].startswith("a clock 1 h ahead explains it")
        assert "all photographs were sent by local" in clock["evidence"]
        assert (len(clock["ids"]), len(clock["heliostats"])) == (CLOCK, CLOCK)
        assert undated["alerts"] == {"times_unknown": UNDATED}
        page = client.get("/attention", headers=HTML).text
        assert "2 probable causes of 199 alarms, and 1 other" in page
        assert len(page) < 400_000
        # As one on the page, the other over REST.
        token = re.findall(r'name="groups" value="(cause:\S+)"', page)[0]
        form = {"groups": token, "why": "Work is ordered", "words": "the clock is being set"}
        page = client.post("/attention/acknowledgements", data=form, headers=HTML).text
        assert f"{CLOCK} acknowledged by local: Work is ordered: the clock is being set" in page
        assert (
            client.post("/attention/acknowledgements", data=form, headers=HTML).status_code == 409
        )
        body = {"ids": undated["ids"], "reason": "times follow"}
        assert client.post(f"{PATH}/acknowledgements", json=body).status_code == 200
        (left,) = client.get(PATH, params={"acknowledged": False}).json()["items"]
        assert (left["reason"], left["severity"]) == ("queue", 1)
        assert client.get(f"{PATH}/causes").json()["items"] == []
        history = client.get(f"{PATH}/history", params={"limit": 500}).json()["items"]
        assert len(history) == 200
        assert 'severity="2"} 187.0' in client.get("/metrics").text


def alerts(*days: float) -> list[Alert]:
    begin = datetime(2026, 1, 1, tzinfo=UTC)
    return [
        Alert("accuracy", f"H{k}", begin + timedelta(days=day), "", "", "")
        for k, day in enumerate(days)
    ]


def test_bursts_are_more_than_the_usual_number():
    assert find_bursts(alerts(1, 1.1, 1.2, 1.3)) == []  # too few
    together = [10 + k / 100 for k in range(12)]
    (burst,) = find_bursts(alerts(1, 2, 3, *together, 20, 30))
    assert len(burst) == 12
    assert find_bursts(alerts(*(k / 5 for k in range(300)))) == []  # five on every day
    assert len(find_bursts(alerts(*together, *(day + 40 for day in together)))) == 2
