"""Every page, and every link and file on it, of a store that the product filled from real
photographs.
"""

import re
import shutil
from collections.abc import Iterator
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient

from model.effects import CATALOGUE
from model.plant_model import JUELICH_MODEL
from model.study import Study, StudyOptions, study, study_to_json
from model.study.judging import Gain
from model.study.outcome import Found
from model.study.parameters import ParameterVector, Term
from service import store
from service.base.settings import FIGURE_SCALES
from service.twin import model_versions
from service.twin.studies.study import StoredStudy, StudyIn, StudyInputs, row_of_report, study_row
from tests.model.scenes import photographs
from tests.page import Page
from tests.service import real
from tests.service.web.crawling import crawl

GAIN = Gain(0.02, 0.01, 0.03, 4.0)
DAY = date(2024, 6, 16)


def found(name: str, **scope: Any) -> Found:
    """An effect in a scope, as a study finds it."""
    term = Term(CATALOGUE[name], **scope)
    unknowns = ParameterVector((term,), (("far", 4), ("middle", 4), ("near", 4)))
    values = 0.8 * unknowns.neutral + 0.2 * np.mean(unknowns.bounds, axis=0)
    return Found(name, GAIN, GAIN, ["camera_blur"]).fitted(
        term, unknowns, values, np.full(len(values), 0.01)
    )


FOUND = {
    "set": [found("sun_shape")],
    "set of one heliostat": [found("slope_error", heliostats=("far",))],
    "since, a heliostat": [found("facet_canting", since=DAY, heliostats=("far",))],
    "since, all": [found("camera_response", since=DAY)],
    "day": [found("sun_shape", days=(date(2024, 6, 1), DAY))],
    "several": [
        found("camera_shoulder"),
        found("soiling"),
        found("blocking", heliostats=("near",)),
    ],
}


def studies() -> Iterator[Study]:
    """Studies of every verdict and every kind of scope; with and without motors."""
    options = StudyOptions(("blocking",))
    made = study(photographs(days=3), JUELICH_MODEL, options=options)
    near = (made.before + 3 * made.measured) / 4
    clean = replace(made, before=near, after=near)
    assert clean.verdict == "none"
    moved = np.roll(clean.before, 4, axis=1)
    wrong = replace(clean, before=moved, after=moved)
    assert wrong.verdict == "unexplained"
    yield from (wrong, clean, replace(wrong, found=FOUND["set"]))
    for effects in FOUND.values():
        explained = replace(wrong, after=clean.after, found=effects)
        assert explained.verdict == "effect"
        yield explained
    place = np.full((len(clean.images), 2), 0.5)
    yield replace(
        explained,
        position_residuals_before=4 * place,
        position_residuals_after=place,
        displaced_before=4e-3 * place,
        displaced_after=1e-3 * place,
    )


CONTRACT: dict[str, Any] = {
    "verdict": "effect",
    "images": {"fit": 4, "held_out": 1},
    "before": {"accuracy_mean": 0.8, "accuracy_median": 0.8, "per_image": {"AA39/1": 0.8}},
    "after": {"accuracy_mean": 0.9, "accuracy_median": 0.9, "per_image": {"AA39/1": 0.9}},
    "noise_floor": 0.01,
    "unexplained_share": 0.1,
    "effects": [
        {
            "name": "slope_error",
            "parameters": {"sigma_mrad": {"value": 1.5, "ci95": [1, 2], "unit": "mrad"}},
        }
    ],
    "candidates": [{"name": "slope_error", "accuracy_after": 0.9, "score": 4.0}],
}
"""What `DESIGN.md`, section 7, demands of a report at the least: a file of an earlier version has
no more.
"""


@pytest.fixture(scope="module")
def every_study(real_store: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    """The real store with studies of every kind, one of them adopted, and reports that came from
    files.
    """
    folder = Path(shutil.copytree(real_store, tmp_path_factory.mktemp("every") / "real"))
    with real.client_on(folder) as client:
        with real.runtime_of(client).database.writing() as session:
            model = model_versions.get_model(session)
            for index, made in enumerate(studies()):
                studied = StoredStudy(
                    StudyIn(), model, StudyInputs(skipped={"AB38": "no surface"}), made
                )
                store.add_study(
                    session, study_row(studied, f"Study {index}", {}, "tester", FIGURE_SCALES)
                )
            for document in (study_to_json(made), CONTRACT):
                store.add_study(session, row_of_report(document, "report.json", model, "tester"))
        real.run_job(client, "/v1/jobs/calibrations")
        body = {"target": "multi_focus_tower", "resolution": 16}
        real.run_job(client, "/v1/jobs/forecasts", sun=real.SUN, **body)
        day = {"first_at": "2026-06-21T10:00:00Z", "last_at": "2026-06-21T12:00:00Z"}
        real.run_job(client, "/v1/jobs/plans", name="noon", allowed_w_m2=100.0, **day, **body)
        newest = client.get("/v1/studies").json()["items"][0]["id"]
        assert client.post(f"/v1/studies/{newest}/adopt", json=real.REASON).status_code == 201
        yield client


@pytest.mark.full
def test_every_page_and_every_file_on_it_answers(every_study: TestClient):
    """All that can be reached by links from the first page; a figure of like pages once, for it is
    drawn for each.
    """
    seen, refused = crawl(every_study)
    assert not refused
    pages = [path for path in seen if re.fullmatch(r"/studies/\d+", path)]
    assert len(pages) == len(FOUND) + 4 + 2 + 1
    assert (
        sum("table=parameters" in path for path in seen) == len(pages) - 2
    )  # all but those that found nothing
    assert any("format=npz" in path for path in seen)


def test_a_parameter_is_shown_with_its_scope(every_study: TestClient):
    shown = "".join(
        every_study.get(f"/studies/{number}?table=parameters").text for number in (4, 5, 6, 7, 8)
    )
    for text in (
        "sun shape, circumsolar_ratio",
        "slope error of far, sigma_mrad",
        "facet canting of far since 2024-06-16, x_mrad",
        "camera response since 2024-06-16, gamma",
    ):
        assert text in shown
    assert "sun shape, circumsolar_ratio [1]" in every_study.get("/studies/9").text  # over days


def test_accuracy_of_a_surface_is_the_same_on_all_pages(real_client: TestClient):
    """It was 87.5, 87.9 and 90.1 %, and no page said of which photographs."""
    real_client.headers.update({"Accept": "text/html"})
    decided = real_client.get(
        "/v1/heliostats/AA39/surfaces/decisions", headers={"Accept": "application/json"}
    ).json()["items"][0]
    before, after = (
        f"{100 * decided[name]:.1f}\N{NO-BREAK SPACE}%"
        for name in ("accuracy_before", "accuracy_after")
    )
    page = Page(real_client.get("/heliostats/AA39?candidate=2").text)
    assert (
        f"on the same 5 photographs for both: {before} with version 1, {after} with" in page.words
    )
    assert "above are of the 8 newest that version 1 was not made from" in page.words
    candidate = Page(real_client.get("/heliostats/AA39?version=2").text)
    assert (
        f"{after}mean on 5 photographs that it was not made from"
        in candidate.one("dl", class_="tiles").words
    )
    compared = Page(real_client.get("/compare?heliostat=AA39&version=1&other_version=2").text)
    assert compared.cells("Forecast accuracy")[:2] == [before, after]
    assert "the 5 newest photographs that neither was made from" in compared.words
