"""README and the guide: length, sentences, links, and sections that the service links to."""

import hashlib
import re
import subprocess
from pathlib import Path

import pytest
from typer.main import get_command

from docs.backend import GUIDE
from docs.generate import FOLDER, write_pages
from heliotwin.cli.main import app
from service.base.settings import Settings
from service.twin.alarms.reasons import REASONS

from .prose import DOCS, ROOT, pages, sentences, statistics_of

README = ROOT / "README.md"


def test_readme_is_short_and_has_a_picture():
    text = README.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 150
    assert len(text.split()) <= 900
    assert re.search(r"^!\[", text, re.MULTILINE)


def test_answer_in_the_readme_is_that_of_its_photograph():
    """A photograph without an id is named by the hash of its file."""
    digest = hashlib.sha256((DOCS / "images" / "photograph.jpg").read_bytes()).hexdigest()
    assert f'"id": "{digest[:16]}"' in README.read_text(encoding="utf-8")


@pytest.mark.parametrize("name", ["README", "guide"])
def test_sentences_are_short(name: str):
    chosen = [page for page in pages() if (page == README) == (name == "README")]
    found = statistics_of([page.read_text(encoding="utf-8") for page in chosen])
    assert len(found.lengths) > 30
    assert not found.faults()


def test_sentences_are_counted_as_a_reader_counts_them():
    text = "# Title\n\nOne [link](x.md) is here. Two;\nthree `a; b`.\n\n"
    text += "```bash\nno text\n```\n- item one\n"
    assert sentences(text) == ["One link is here.", "Two; three code.", "item one"]


def test_links_lead_to_files_of_a_clone():
    """Of every page at the top and in the guide, so that a forge shows what they lead to."""
    known = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    ).stdout.splitlines()
    files = {(ROOT / name).resolve() for name in known}
    links = [
        (page, target)
        for page in [*ROOT.glob("*.md"), *DOCS.rglob("*.md")]
        for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", page.read_text(encoding="utf-8"))
        if "://" not in target
    ]
    assert len(links) > 100
    missing = [(page, to) for page, to in links if (page.parent / to).resolve() not in files]
    assert not missing


def test_pages_from_the_code_are_current(tmp_path: Path):
    write_pages(tmp_path)
    stale = [
        page.name
        for page in {*tmp_path.iterdir(), *FOLDER.iterdir()}
        if not (FOLDER / page.name).is_file()
        or not (tmp_path / page.name).is_file()
        or (FOLDER / page.name).read_bytes() != (tmp_path / page.name).read_bytes()
    ]
    assert not stale, "python -m docs.generate writes them"


def test_every_alarm_has_its_section_with_meaning_cause_and_action():
    """The anchors are those that the page of alarms links to."""
    text = (DOCS / "how-to" / "operator" / "alarms.md").read_text(encoding="utf-8")
    sections = re.findall(r"^\((\w+)\)=\n## (\w+):(.*?)(?=^\(|\Z)", text, re.MULTILINE | re.DOTALL)
    assert [anchor for anchor, _, _ in sections] == list(REASONS)
    for anchor, title, section in sections:
        assert anchor == title
        for part in ("Meaning", "Cause", "Action"):
            assert f"**{part}.**" in section


def test_rules_of_prometheus_name_the_sections():
    rules = (ROOT / "docker" / "prometheus-rules.yml").read_text(encoding="utf-8")
    anchors = re.findall(r"runbook: /docs/guide/how-to/operator/alarms.html#(\S+)", rules)
    assert anchors == [reason.replace("_", "-") for reason in REASONS]


def test_settings_verbs_and_files_that_pages_name_exist():
    text = "\n".join(page.read_text(encoding="utf-8") for page in pages())
    settings = {f"HELIOTWIN_{name.upper()}" for name in Settings.model_fields}
    composition = (ROOT / "docker" / "compose.yaml").read_text(encoding="utf-8")
    named = set(re.findall(r"HELIOTWIN_[A-Z_]*[A-Z]", text))
    assert not [n for n in named - settings if f"{{{n}" not in composition]
    verbs = set(re.findall(r"(?:^|`|bin/)heliotwin ([a-z]+)", text, re.MULTILINE))
    assert len(verbs) > 10
    assert not verbs - set(get_command(app).commands)
    files = re.findall(r"`((?!out/)(?:[a-z_]+/)+[a-z_]+\.(?:py|yml|yaml|json|sh))`", text)
    assert len(files) > 10
    assert not [f for f in files if not ((ROOT / f).exists() or (ROOT / "service" / f).exists())]


def test_anchors_of_alarms_are_those_of_the_built_page():
    """Sphinx writes hyphens in them; the template of the alarms replaces them likewise."""
    built = GUIDE / "how-to" / "operator" / "alarms.html"
    if not built.exists():
        pytest.skip("the guide is not built: make docs")
    page = built.read_text(encoding="utf-8")
    for reason in REASONS:
        assert f'id="{reason.replace("_", "-")}"' in page
