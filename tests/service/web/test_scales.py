"""Colours mean the same on all pages: maps end where the settings say, and differences have one
sign.
"""

import io
import re
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient
from pydantic import ValidationError

from service.base.settings import FIGURE_SCALES, Settings
from service.web.app import create_app
from tests.service.conftest import FakeOperations, Post, client_of, png, sun_at
from tests.service.web.pages import text_of

ENDS = r"Surface \d: deviation[^;]*; from (\S+) to (\S+) mm"


class Uneven(FakeOperations):
    """Predicts another height each time, and forecasts less light on the left than came."""

    def predict(self, *arguments: Any, **options: Any) -> Any:
        made = super().predict(*arguments, **options)
        made.z[:] *= 1 + len(self.predictions)
        return made

    def render(self, *arguments: Any, **options: Any) -> Any:
        forecast = super().render(*arguments, **options).copy()
        forecast[..., :32] *= 0.5
        return forecast


@pytest.fixture
def operations() -> FakeOperations:
    return Uneven()


@pytest.fixture
def pages(client: TestClient, post: Post) -> TestClient:
    for number in (1, 2):
        assert (
            post(png(number), id=f"10{number}", sun=sun_at(180 - 20.0 * number)).status_code == 201
        )
    for used in (["101"], ["101", "102"]):
        assert (
            client.post("/v1/heliostats/AA39/surfaces", json={"measurements": used}).status_code
            == 201
        )
    return client


def test_all_versions_have_one_scale_and_what_lies_beyond_is_said(pages: TestClient):
    heights = []
    for version in (1, 2):
        page = text_of(pages, f"/heliostats/AA39?version={version}")
        assert re.search(ENDS, page).groups() == ("-2", "2")  # type: ignore[union-attr]
        heights += re.findall(
            r"From (\S+) to (\S+) mm: what lies beyond the scale has its end colours", page
        )
    assert heights == [("−3", "3")]  # the first is 2 mm high
    compared = text_of(pages, "/compare?heliostat=AA39&version=1&other_version=2")
    assert compared.count("from -2 to 2 mm") == 2
    assert compared.count("from -1 to 1 mm") == 1


def test_scales_are_settings(pages: TestClient, settings: Settings):
    wide = settings.model_copy(update={"figure_scales": FIGURE_SCALES | {"heights": 5.0}})
    with client_of(create_app(wide, FakeOperations())) as client:
        page = text_of(client, "/heliostats/AA39")
        assert re.search(ENDS, page).groups() == ("-5", "5")  # type: ignore[union-attr]
        assert "beyond the scale" not in page
        drawn = [
            one.get("/v1/heliostats/AA39/surfaces/2?format=png").content for one in (pages, client)
        ]
    assert drawn[0] != drawn[1]


@pytest.mark.parametrize("given", [{"height": 1.0}, {"heights": 0.0}, {"heights": float("inf")}])
def test_wrong_scales_are_refused(given: dict[str, float]):
    with pytest.raises(ValidationError, match=next(iter(given))):
        Settings(figure_scales=given)


def test_difference_is_forecast_minus_photograph(pages: TestClient):
    arrays = np.load(
        io.BytesIO(pages.get("/heliostats/AA39/photographs/101?figure=compared&format=npz").content)
    )
    np.testing.assert_allclose(
        arrays["difference"], arrays["forecast"] - arrays["measured"], atol=1e-7
    )
    assert arrays["difference"][:, :30].max() < 0
    page = text_of(pages, "/heliostats/AA39/photographs/101")
    assert "from -0.3 to 0.3 of the measured peak" in page
