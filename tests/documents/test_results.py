"""Results: records, the pages that show them, and the tables that are rendered from them."""

import json
import re

import numpy as np
import pytest

from benchmarks import record
from benchmarks.record import Estimate, log_row, recording
from docs import figures

from .prose import DOCS, ROOT

TOPICS = sorted(path for path in (DOCS / "results").glob("*.md") if path.name != "index.md")
KEYS = {"table", "row", "name", "value", "unit", "n", "of", "interval", "level", "std"}
KEYS |= {"compared_with", "goal"}


def test_results_are_rendered_from_the_records():
    """``python -m docs.figures`` writes them."""
    assert (ROOT / "RESULTS.md").read_text(encoding="utf-8") == figures.results_page()


def test_figures_of_the_readme_are_those_of_the_records():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert figures.readme_table() in text
    assert figures.readme(text) == text


@pytest.mark.parametrize("name", figures.records())
def test_record_says_how_it_was_measured(name: str):
    record = figures.read(name)
    assert record["name"] == name
    if "source" not in record:
        assert re.fullmatch(r"\d{4}-\d\d-\d\d", record["date"])
        assert record["command"].startswith("python -m ")
        assert record["machine"]["cores"] > 0
        assert record["machine"]["processor"]
        assert re.fullmatch(r"[0-9a-f]{7,}\+?", record["commit"])
    assert not re.search(r'"/|[ =]/(work|home|tmp|root)\b', json.dumps(record))


@pytest.mark.parametrize("name", figures.records())
def test_figures_of_a_record_are_unique_and_complete(name: str):
    found = figures.read(name)["figures"]
    places = [(one["table"], one["row"], one["name"]) for one in found]
    assert places
    assert len(set(places)) == len(places)
    for one in found:
        assert not set(one) - KEYS
        assert one["value"] is not None
        if "interval" in one:
            low, high = one["interval"]
            assert low <= high
            assert one["level"] in (90, 95)
        if "goal" in one:
            assert re.fullmatch(r"[<>]= [\d.]+", one["goal"])


def test_each_record_is_shown_on_one_page():
    shown = [
        name for page in TOPICS for name in figures.shown_records(page.read_text(encoding="utf-8"))
    ]
    assert sorted(shown) == [name for name in figures.records() if name != "published"]


@pytest.mark.parametrize("page", TOPICS, ids=lambda page: page.stem)
def test_numbers_of_a_page_are_in_its_records(page):
    """Each measured number in the prose is in a table of the page."""
    text = page.read_text(encoding="utf-8")
    prose = re.sub(r"```.*?```|`[^`]*`|\]\([^)]*\)", "", text, flags=re.DOTALL)
    numbers = set(re.findall(r"\d+\.\d+|\d+(?= %)", prose))
    tables = "\n".join(map(figures.block, figures.shown_records(text)))
    assert not [number for number in numbers if number not in tables]


def test_overview_has_goals_that_are_missed():
    missed = [one for one in figures.key_figures() if figures.is_missed(one["figure"])]
    assert missed
    for one in missed:
        assert figures.goal(one["figure"]["goal"]) in figures.key_table()


def test_number_has_three_significant_digits():
    shown = {0.104: "0.104", 0.9: "0.900", 29.48: "29.5", 0.035: "0.035", 1256: "1,256"}
    shown |= {2290.4: "2,290", -0.0123: "-0.012", 0.0: "0", True: "yes", "none": "none"}
    assert {value: figures.number(value) for value in shown} == shown


def test_goal_says_which_way_it_is_missed():
    assert figures.is_missed({"value": 1.24, "goal": "<= 1.2"})
    assert not figures.is_missed({"value": 1.2, "goal": "<= 1.2"})
    assert figures.is_missed({"value": 0.899, "goal": ">= 0.92"})
    assert not figures.is_missed({"value": 0.5})


def test_recording_writes_what_is_logged_in_it(tmp_path, monkeypatch):
    monkeypatch.setattr(record, "RESULTS", tmp_path)
    log_row("outside", "row", {"value": 1})
    with recording("some"):
        cells = {"error [mm]": Estimate(np.float32(0.25), (0.2, 0.3), 90, "<= 0.3"), "seen": None}
        log_row("table", "row", cells | {"missing": np.nan}, n=3, of="mirrors", compared_with="it")
    with recording("nothing"):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["some.json"]
    written = json.loads((tmp_path / "some.json").read_text(encoding="utf-8"))
    figure = {"table": "table", "row": "row", "name": "error", "value": 0.25, "unit": "mm", "n": 3}
    figure |= {"of": "mirrors", "interval": [0.2, 0.3], "level": 90, "compared_with": "it"}
    assert written.pop("figures") == [figure | {"goal": "<= 0.3"}]
    assert set(written) == {"name", "command", "date", "commit", "machine"}


def test_a_run_that_fails_leaves_its_record(tmp_path, monkeypatch):
    def run() -> None:
        with recording("some"):
            log_row("table", "row", {"value": 1})
            raise ZeroDivisionError

    monkeypatch.setattr(record, "RESULTS", tmp_path)
    with pytest.raises(ZeroDivisionError):
        run()
    assert not list(tmp_path.iterdir())


def test_units_and_counts_are_in_the_head_or_in_the_rows():
    one = {"table": "t", "row": "a", "name": "error", "value": 0.5, "unit": "mm", "n": 3}
    head = figures.table([one | {"of": "mirrors"}]).splitlines()[0]
    assert head == "|  | mirrors | error [mm] |"
    other = one | {"row": "b", "name": "error", "value": 2.0, "unit": "s", "n": 3}
    assert figures.table([one, other]).splitlines()[2:] == [
        "| a [mm] | 3 | 0.500 |",
        "| b [s] | 3 | 2.00 |",
    ]


def test_every_benchmark_records_its_figures():
    programs = [
        path.stem
        for path in (ROOT / "benchmarks").glob("*.py")
        if '__name__ == "__main__"' in (text := path.read_text(encoding="utf-8"))
        and "recording(" not in text
    ]
    assert programs == []
