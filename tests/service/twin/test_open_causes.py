"""Causes of heliostats without an active surface, and of open alarms."""

from datetime import UTC, datetime, timedelta

import pytest

from service.twin.alarms.alarms import Alarm
from service.twin.alarms.causes import HeliostatFacts, PhotographFacts, outlier_reasons, rank_causes
from service.twin.alarms.field_overview import ActiveSurface, HeliostatOverview
from service.twin.alarms.reasons import Reason
from service.twin.surfaces.present_shape import DayOfOthers

SURFACE = ActiveSurface(1, 1, "network", None, 0.03)
NOW = datetime(2026, 6, 1, tzinfo=UTC)
PHOTOGRAPHS = [PhotographFacts(str(n), None, (0.0, -0.8, 0.6), 0.64) for n in range(3)]


def test_no_surface_is_the_first_cause_and_blames_no_photograph():
    facts = HeliostatFacts(0.75, PHOTOGRAPHS, HeliostatOverview("R10-10", 0, 0), {})
    first, *_ = rank_causes(facts)
    assert (first.kind, first.label) == ("no_surface", "No surface is active")
    assert outlier_reasons(facts) == {}
    assert first.offer is not None
    assert (first.offer["path"], first.offer["body"]) == (
        "/v1/jobs/predictions",
        {"heliostats": ["R10-10"], "method": "refined"},
    )


@pytest.mark.parametrize(
    ("reason", "kind"),
    [("dimmed", "soiled"), ("no_photograph", "no_photograph"), ("drift", "moved")],
)
def test_an_open_alarm_is_a_cause(reason: Reason, kind: str):
    line = HeliostatOverview("R03-05", 0, 0, surface=SURFACE)
    alarm = Alarm(reason, "R03-05", NOW, "said so", "do", "")
    facts = HeliostatFacts(0.5, PHOTOGRAPHS, line, {}, alarms={reason: alarm})
    assert (kind, "said so") in {(one.kind, one.evidence) for one in rank_causes(facts)}


@pytest.mark.parametrize(("others", "kind"), [(0.93, "foreign_light"), (0.91, "haze")])
def test_a_slightly_worse_day_of_all_heliostats_blames_no_photograph(others: float, kind: str):
    """Thin haze lowers near heliostats less than far ones, and no photograph of it is foreign."""
    values = [0.95, 0.951, 0.949, 0.95, 0.952, 0.95, 0.948, 0.88, 0.95]
    taken = [
        PhotographFacts(str(n), NOW + timedelta(days=n), (0.0, -0.8, 0.6), value)
        for n, value in enumerate(values)
    ]
    day = (NOW + timedelta(days=7)).date()
    line = HeliostatOverview("R03-05", 0, 0, surface=SURFACE)
    facts = HeliostatFacts(0.5, taken, line, {day: DayOfOthers(8, 7, others, 0.94)})
    assert list(outlier_reasons(facts)) == ["7"]
    (found,) = [one for one in rank_causes(facts) if one.measurements]
    assert (found.kind, found.measurements) == (kind, ("7",))
