"""``heliotwin study``: the report of DESIGN.md, section 7, its page, and what it says
to bad input.
"""

import json
import re
import shutil
import sys
from collections.abc import Callable
from dataclasses import replace
from datetime import date
from pathlib import Path

import numpy as np
import pytest

from heliotwin.cli.main import main
from heliotwin.folder_forecast import forecast_folder
from heliotwin.folder_study import FolderStudy, study_folder
from model.effects import CATALOGUE, effects_from_json
from model.effects.facet_canting import FacetCanting
from model.effects.sun_shape import SunShapeEffect
from model.errors import InvalidInputError
from model.study import StudyOptions, conclude, study_to_json
from model.study.judging import Gain
from model.study.outcome import Found
from model.study.parameters import ParameterVector, Term
from service.base.fields import StudyReport
from service.base.settings import FIGURE_SCALES
from service.drawing.study_report import study_page
from service.sources.folder import read_folder
from tests.page import Page

HELIOSTATS = ("AD34", "AR18")

GAIN = Gain(0.02, 0.01, 0.03, 4.0)


@pytest.fixture(scope="module")
def few(undeclared, tmp_path_factory) -> Path:
    """Three images of two heliostats each, of a set under a hazy sky."""
    return copy(undeclared / "set-5", tmp_path_factory.mktemp("few"), 3)


def copy(source: Path, root: Path, images: int) -> Path:
    """A folder of few heliostats and images."""
    for path in source.glob("*.json"):
        shutil.copy(path, root)
    for name in HELIOSTATS:
        for part in ("Properties", "Deflectometry"):
            shutil.copytree(source / name / part, root / name / part)
        (root / name / "Calibration").mkdir()
        kept = sorted((source / name / "Calibration").glob("*-calibration-properties.json"))[
            :images
        ]
        for about in kept:
            for path in about.parent.glob(about.name.split("-")[0] + "-*"):
                shutil.copy(path, root / name / "Calibration")
    return root


@pytest.fixture(scope="module")
def hazy(few) -> FolderStudy:
    return study_folder(
        read_folder(few), options=StudyOptions(candidates=("sun_shape", "camera_blur"))
    )


@pytest.fixture(scope="module")
def clean(undeclared, tmp_path_factory) -> FolderStudy:
    """Of a folder that declares the sun that it has."""
    root = copy(undeclared / "set-5", tmp_path_factory.mktemp("clean"), 3)
    found = study_folder(
        read_folder(root), options=StudyOptions(candidates=("sun_shape",))
    ).study.effects[0]
    options = StudyOptions(candidates=("sun_shape", "axis_tilt"))
    return study_folder(read_folder(root), options=options, effects=[found])


# --- the command
# --------------------------------------------------------------------------------------------------


@pytest.fixture
def heliotwin(monkeypatch, capsys) -> Callable[..., tuple[int, str, str]]:
    """Run the command in this process: exit code, standard output and standard error."""

    def run(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["heliotwin", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            main()
        said = capsys.readouterr()
        return ended.value.code, said.out, said.err

    return run


def test_the_report_keeps_the_contract_and_serves_forecasts(few, tmp_path, heliotwin, monkeypatch):
    monkeypatch.setenv("HELIOTWIN_FIGURE_SCALES", '{"flux_difference": 0.2}')

    def report_of(*arguments: object) -> dict:
        code, said, trouble = heliotwin(*arguments, "--json")
        assert code == 0, trouble
        return json.loads(said)

    files = ("--out", tmp_path / "new" / "r.json", "--html", tmp_path / "new" / "r.html")
    report = report_of("study", few, *files)
    assert json.loads((tmp_path / "new" / "r.json").read_text()) == report
    assert report["verdict"] == "effect"
    assert report["images"] == {"fit": 4, "held_out": 2}
    for part in ("before", "after"):
        accuracies = report[part]["per_image"]
        assert {key.split("/")[0] for key in accuracies} == set(HELIOSTATS)
        assert report[part]["accuracy_mean"] == pytest.approx(
            np.mean(list(accuracies.values())), abs=2e-5
        )
        assert report[part]["accuracy_median"] == pytest.approx(
            np.median(list(accuracies.values())), abs=2e-5
        )
    assert 0 < report["noise_floor"] < 0.05
    assert 0 <= report["unexplained_share"] <= 1
    for effect in report["effects"]:
        names = {p.name for p in CATALOGUE[effect["name"]].parameters()}
        assert set(effect["parameters"]) == names - {"east_deg"}  # it turns the first axis
        for parameter in effect["parameters"].values():
            assert set(parameter) == {"value", "ci95", "unit"}
        assert effect["accuracy_gain"]["ci95"][0] > 0
        assert set(effect["told_apart_by"]) == set(effect["lookalikes"])
    accuracies = [candidate["accuracy_after"] for candidate in report["candidates"]]
    assert accuracies == sorted(accuracies, reverse=True)
    shaped = {
        name for name, kind in CATALOGUE.items() if not (kind.only_moves or kind.needs_neighbours)
    }
    assert {candidate["name"] for candidate in report["candidates"]} == shaped
    assert "skipped" not in report
    page = (tmp_path / "new" / "r.html").read_text(encoding="utf-8")
    assert report["conclusion"] in text(page)
    assert "Colours from -0.2 to 0.2 of the measured peak" in page

    plain = report_of("forecast", few, "--out", tmp_path / "plain")
    better = report_of(
        "forecast", few, "--out", tmp_path / "better", "--effects", tmp_path / "new" / "r.json"
    )
    assert (
        better["accuracy_mean"]
        > plain["accuracy_mean"] + 0.5 * report["effects"][0]["accuracy_gain"]["mean"]
    )


def test_an_effect_of_the_plant_is_tried_and_serves_forecasts(few, tmp_path, heliotwin):
    own, files = tmp_path / "own.py", ("--effects-from", tmp_path / "own.py")
    own.write_text(
        "from heliotwin.effects import blur_effect\n"
        "blur_effect('veil', 'Veil: of a test.', lambda seen: 1.0, 0, 5)\n"
    )
    try:
        code, said, _ = heliotwin("study", few, "--out", tmp_path / "r.json", *files, "--json")
        assert code == 0
        assert "veil" in {candidate["name"] for candidate in json.loads(said)["candidates"]}
        effects = tmp_path / "effects.json"
        effects.write_text('[{"name": "veil", "parameters": {"amplitude": 1.0}}]')
        arguments = ("forecast", few, "--out", tmp_path / "flux", "--effects", effects)
        assert heliotwin(*arguments, *files)[0] == 0
    finally:
        CATALOGUE.pop("veil", None)
    code, _, trouble = heliotwin(*arguments)
    assert code == 2
    assert "--effects-from" in trouble


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("nowhere", "--out", "x"), "no such folder"),
        (("FOLDER", "--out", "."), "is a folder; name a file"),
        (("FOLDER", "--out", "x", "--surfaces", "nowhere"), "--surfaces must be"),
        (
            ("FOLDER", "--out", "x", "--surfaces", "."),
            "got 0 (AD34: no surface in AD34/Deflectometry; AR18",
        ),
        (("FOLDER", "--out", "x", "--effects", "nowhere.json"), "nowhere.json: no such file"),
        (("FOLDER", "--out", "x", "--effects-from", "no.py"), "no.py: no such file of effects"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(few, heliotwin, arguments, says):
    code, _, trouble = heliotwin("study", *(few if a == "FOLDER" else a for a in arguments))
    assert code == 2
    assert says in trouble
    assert len(trouble.strip().splitlines()) == 1
    assert not Path("x").exists()


# --- what is left out
# -------------------------------------------------------------------------------------------------


def changed(few: Path, root: Path, change: Callable[[dict], None]) -> str:
    """Copy the folder with the properties of one measurement changed; gives back its key."""
    shutil.copytree(few, root, dirs_exist_ok=True)
    path = min((root / "AD34" / "Calibration").glob("*-calibration-properties.json"))
    about = json.loads(path.read_text())
    change(about)
    path.write_text(json.dumps(about))
    return f"AD34/{path.name.split('-')[0]}"


def test_a_heliostat_without_a_prediction_is_skipped_by_name(few, tmp_path):
    """The other one is not enough for a study, and the error says why there is no more."""
    shutil.copytree(few / "AD34" / "Deflectometry", tmp_path / "AD34" / "Deflectometry")
    with pytest.raises(
        InvalidInputError, match=r"at least 4 photographs, got 3 \(AR18: no surface in"
    ):
        study_folder(read_folder(few), str(tmp_path))


def test_a_spot_off_its_target_is_skipped_by_name(few, tmp_path):
    def raise_spot(about: dict) -> None:
        for place in about["focal_spot"].values():
            place[2] += 30

    key = changed(few, tmp_path, raise_spot)
    done = study_folder(read_folder(tmp_path), options=StudyOptions(candidates=("sun_shape",)))
    assert list(done.skipped) == [key]
    assert f"{key}: 'focal_spot' lies off its target" in done.skipped[key]
    assert done.to_json()["skipped"] == done.skipped
    assert key in text(study_page(done.study, "few", FIGURE_SCALES, done.skipped))


# --- the page
# --------------------------------------------------------------------------------------------------


def text(page: str) -> str:
    """The words of a page, blanks made one."""
    return re.sub(r"\s+", " ", Page(page).words)


def test_accuracies_are_in_percent_as_on_all_pages(hazy):
    page = text(study_page(hazy.study, "few", FIGURE_SCALES))
    before, after = (
        100 * float(values.mean())
        for values in (hazy.study.accuracy_before, hazy.study.accuracy_after)
    )
    assert f"{before:.1f} % → {after:.1f} %" in page
    assert f"rises from {before:.1f}% to {after:.1f}%" in conclude(hazy.study)
    assert "accuracy [%]" in page
    assert f"{100 * hazy.study.found[0].gain.mean:.1f} points" in page


def test_the_page_stands_alone(hazy):
    page = study_page(hazy.study, "few", FIGURE_SCALES)
    elements = Page(page).all()
    assert not {"script", "link", "iframe", "object", "form"} & {one.tag for one in elements}
    addresses = Page(page).links
    assert all(address.startswith("data:image/png;base64,") for address in addresses)
    assert len(addresses) == 3 * 5 + 1
    rest = re.sub(r"data:image/png;base64,[^\"]*", "", page)
    assert not re.search(r"https?:|//[a-z]|url\((?!#)|@import|style=", rest)
    for drawing in Page(page).all("svg", role="img"):
        assert drawing.attributes.get("aria-label") or drawing.attributes.get("aria-labelledby")


def test_the_page_says_what_was_found(hazy):
    page = study_page(hazy.study, "few", FIGURE_SCALES)
    words = text(page)
    assert conclude(hazy.study) in words
    assert words.index(conclude(hazy.study)) < words.index("Mean accuracy")
    assert "Effect found" in words
    ratio = study_to_json(hazy.study)["effects"][0]["parameters"]["circumsolar_ratio"]
    assert f"{ratio['value']:.3f}{ratio['ci95'][0]:.3f} to {ratio['ci95'][1]:.3f}" in words
    assert "camera blur" in words
    for photograph in hazy.study.images:
        assert photograph.key in words


def test_the_page_of_a_complete_model_shows_no_after(clean):
    words = text(study_page(clean.study, "few", FIGURE_SCALES))
    assert clean.study.verdict == "none"
    assert "Nothing missing" in words
    assert "forecast after" not in words
    assert "There is nothing to adopt" in words


def test_what_has_no_name_is_on_the_page_and_its_report_forecasts_as_it_says(few, tmp_path):
    """A hazy sky, of which a study of cameras alone says where it lives."""
    options = StudyOptions(candidates=("camera_ghost",))
    done = study_folder(read_folder(few), options=options)
    report = done.to_json()
    assert report["verdict"] == "unexplained"
    assert report["partly"] == [effect["name"] for effect in report["effects"]]
    read = StudyReport.model_validate(report).discrepancy
    assert read is not None
    assert read.model_dump(mode="json") == report["discrepancy"]
    words = text(study_page(done.study, "few", FIGURE_SCALES))
    assert read.in_words in words
    assert "is a correction and no cause" in words
    telling = [c for c in read.coefficients if c.ci95[0] > 0 or c.ci95[1] < 0]
    assert f"not zero: {len(telling)} of {len(read.coefficients)}" in words
    assert all(c.name in words for c in telling)
    assert "Photographs to take next" in words
    if read.rival is not None:
        assert read.rival.distinguished_by in words
    assert "What the correction changes in the forecasts" in words
    # Its correction forecasts as the report says, from the file and on the whole targets.
    folder, effects = read_folder(few), effects_from_json(json.loads(json.dumps(report)))
    forecast = forecast_folder(folder, tmp_path, window=report["window_m"], effects=effects)
    accuracies = [forecast["measurements"][key]["accuracy"] for key in read.per_image]
    assert np.mean(accuracies) == pytest.approx(read.accuracy_after, abs=0.005)


def test_look_alikes_come_with_the_photographs_that_decide(hazy):
    (found,) = hazy.study.found
    ambiguous = replace(hazy.study, found=[replace(found, lookalikes=["slope_error"])])
    words = text(study_page(ambiguous, "few", FIGURE_SCALES))
    assert (
        "Slope error would do as well. To decide, photograph several heliostats within the same"
        " hour" in words
    )
    assert "Before the effect is adopted" in words


def test_parameters_of_facets_stand_in_columns(hazy):
    term = Term(FacetCanting)
    unknowns = ParameterVector((term,), (("AD34", 4), ("AR18", 4)))
    values = np.linspace(-1, 1, 16)
    found = Found("facet_canting", GAIN, GAIN, []).fitted(term, unknowns, values, np.full(16, 0.1))
    page = study_page(replace(hazy.study, found=[found]), "few", FIGURE_SCALES)
    assert "Facet 4" in text(page)
    assert page.count("<code>x_mrad</code>") == page.count("<code>y_mrad</code>") == 2
    telling = [abs(v) > 0.196 for v in values]
    strong = [cell for cell in Page(page).all("td") if cell.all("strong") and cell.all("small")]
    assert len(strong) == sum(telling)


def test_what_comes_and_goes_is_shown_by_day(hazy):
    days = date(2024, 6, 7), date(2024, 6, 9)
    term = Term(SunShapeEffect, days=days)
    found = Found("sun_shape", GAIN, GAIN, []).fitted(
        term, ParameterVector((term,), (("AD34", 4),)), np.array([0.02, 0.2]), np.full(2, 0.01)
    )
    words = text(study_page(replace(hazy.study, found=[found]), "few", FIGURE_SCALES))
    assert "Sun shape by day (most on 2024-06-09)" in words
    assert all(row in words for row in ("other days", "2024-06-07", "2024-06-09"))


def test_names_are_text_wherever_they_come_from(hazy):
    evil = '"><script>alert(1)</script>'
    photographs = [
        replace(
            p,
            setup=replace(
                p.setup, identifier=f"{evil}/{n}", heliostat=replace(p.setup.heliostat, name=evil)
            ),
        )
        for n, p in enumerate(hazy.study.images)
    ]
    page = study_page(replace(hazy.study, images=photographs), evil, FIGURE_SCALES, {evil: evil})
    assert "<script" not in page
    assert not Page(page).all("script")
    assert evil in Page(page).words
