"""Causes of heliostats without an active surface, and of open alarms."""

import pytest

from service.twin.alarms.causes import HeliostatFacts, PhotographFacts, outlier_reasons, rank_causes
from service.twin.alarms.field_overview import ActiveSurface, HeliostatOverview
from service.twin.alarms.reasons import Reason

SURFACE = ActiveSurface(1, 1, "network", None, 0.03)
PHOTOGRAPHS = [PhotographFacts(str(n), None, (0.0, -0.8, 0.6), 0.64) for n in range(3)]


def test_no_surface_is_the_first_cause_and_blames_no_photograph():
    facts = HeliostatFacts(0.75, PHOTOGRAPHS, HeliostatOverview("R10-10", 0, 0), {})
    first, *_ = rank_causes(facts)
    assert (first.kind, first.label) == ("no_surface", "No surface is active")
    assert outlier_reasons(facts) == {}
    assert first.offer is not None
    assert (first.offer.path, first.offer.body) == (
        "/v1/jobs/predictions",
        {"heliostats": ["R10-10"], "method": "refined"},
    )


@pytest.mark.parametrize(
    ("reason", "kind"),
    [("dimmed", "soiled"), ("no_photograph", "no_photograph"), ("drift", "moved")],
)
def test_an_open_alarm_is_a_cause(reason: Reason, kind: str):
    line = HeliostatOverview("R03-05", 0, 0, surface=SURFACE)
    facts = HeliostatFacts(0.5, PHOTOGRAPHS, line, {}, alarms={reason: "said so"})
    assert (kind, "said so") in {(one.kind, one.evidence) for one in rank_causes(facts)}
