"""Charts of a discrepancy: the amount over the covariate that it scales with."""

import pytest

from service.drawing.study_charts import amount_charts

PER = {"covariate": "sun_elevation", "unit": "deg", "center": 30.0, "limits": [20.0, 50.0]}


def entry(name, value, per=None, of=None, spread=0.1):
    interval = [value - spread, value + spread]
    about = {"kind": "each facet", "unit": "mrad/m", "of": of, "ci95": interval}
    return {"name": name, "value": value, "per": per} | about


def test_lines_go_through_the_constant_at_the_center_within_what_was_covered():
    (chart,) = amount_charts([entry("xx", 4.0), entry("xx", -0.2, PER), entry("yy", 0.0, PER)])
    assert chart.title == "each facet: xx [mrad/m]"
    assert chart.label == "sun elevation [deg]"
    (line,) = chart.lines
    # 6 at 20 degrees and 0 at 50, with a margin of 6 %
    assert (line.left, line.right) == pytest.approx((1 - 0.06 / 1.12, 0.06 / 1.12))
    assert chart.zero == pytest.approx(line.right)


def test_owners_have_lines_and_constants_of_their_own_and_none_scales_without_certainty():
    some = [
        entry("xx", 1.0, of="AA39"),
        entry("xx", 0.5, PER, "AA39"),
        entry("xx", -0.5, PER, "AB12"),
    ]
    (chart,) = amount_charts(some)
    assert [line.of for line in chart.lines] == ["AA39", "AB12"]
    assert chart.lines[0].left < chart.lines[0].right
    assert amount_charts([entry("xx", 4.0), entry("xx", 0.05, PER)]) == []
