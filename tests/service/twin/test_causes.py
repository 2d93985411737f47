"""Why a heliostat is bad, of stores that the product filled from real photographs."""

import json
import shutil
from collections.abc import Sequence
from pathlib import Path

import cv2
import pytest
from fastapi.testclient import TestClient

from service.sources.paint_documents import azimuth_from_north
from tests.page import Page
from tests.service import real
from tests.service.conftest import poster

TOWER = "WRI1030197-tower-measurements.json"
HAZY, CLEAR = "2023-06-13", "2023-06-12"


def lay_out(stj: Path, folder: Path, names: Sequence[str] = ("AA39",)) -> None:
    """A folder to import: the plant, and AA39's properties and measured surface by these names."""
    shutil.copytree(stj / "AA39" / "Properties", folder / "AA39" / "Properties")
    shutil.copytree(stj / "AA39" / "Deflectometry", folder / "AA39" / "Deflectometry")
    shutil.copy(stj / TOWER, folder)
    for name in names[1:]:
        for part in ("Properties", "Deflectometry"):
            made = folder / name / part
            made.mkdir(parents=True)
            for file in (stj / "AA39" / part).iterdir():
                shutil.copy(file, made / file.name.replace("AA39", name))


def taken(years: Path) -> dict[str, str]:
    """Times of the dated photographs of AA39 by their number."""
    files = (years / "AA39" / "Calibration").glob("*-item-stac.json")
    return {
        file.name.split("-")[0]: json.loads(file.read_text())["properties"]["datetime"]
        for file in sorted(files)
    }


def add_photographs(
    years: Path, folder: Path, numbers: Sequence[str], name: str = "AA39"
) -> list[Path]:
    """Copy photographs of AA39, and return their images."""
    made = folder / name / "Calibration"
    made.mkdir(parents=True, exist_ok=True)
    for number in numbers:
        for file in (years / "AA39" / "Calibration").glob(f"{number}-*"):
            shutil.copy(file, made)
    return sorted(made.glob("*-cropped.png"))


def veil(image: Path, share: float) -> None:
    """Spread a share of the light of a photograph widely, as haze does."""
    pixels = cv2.imread(str(image))
    wide = cv2.GaussianBlur(pixels, (0, 0), 20)
    cv2.imwrite(str(image), cv2.addWeighted(pixels, 1 - share, wide, share, 4))


@pytest.fixture
def years(stj: Path) -> Path:
    root = stj.parent / "stj-years"
    if not root.is_dir():
        pytest.skip(f"no photographs of years at {root}")
    return root


def shown_page(client: TestClient, name: str = "AA39") -> Page:
    """The page of a heliostat."""
    return Page(client.get(f"/heliostats/{name}", headers={"Accept": "text/html"}).text)


def causes_of(client: TestClient, name: str = "AA39") -> list[str]:
    """The causes that the page of a heliostat ranks; none without the card."""
    shown = shown_page(client, name)
    return [one.words for card in shown.all("ol", class_="causes") for one in card.all("li")]


def test_wrong_clock_is_the_first_cause(stj: Path, years: Path, tmp_path: Path):
    lay_out(stj, tmp_path / "import" / "plant")
    known = taken(years)
    numbers = [
        number for number, at in known.items() if at.startswith(("2023-06-12", "2023-06-13"))
    ]
    images = add_photographs(years, tmp_path / "import" / "plant", numbers)
    for image in images[:4]:
        item = image.with_name(image.name.replace("cropped.png", "calibration-item-stac.json"))
        document = json.loads(item.read_text())
        hour = int(document["properties"]["datetime"][11:13]) + 2
        at = document["properties"]["datetime"]
        document["properties"]["datetime"] = f"{at[:11]}{hour:02d}{at[13:]}"
        item.write_text(json.dumps(document))
    with real.client_on(tmp_path) as client:
        real.run_job(client, "/v1/jobs/imports", folder="plant")
        first = causes_of(client)[0]
    assert "Wrong sun or clock" in first
    assert f"4 photographs of {len(numbers)}" in first
    assert "2 h" in first or "two hours" in first, first
    assert "Correct time or sun" in first


@pytest.mark.full
def test_few_suns(stj: Path, years: Path, tmp_path: Path):
    lay_out(stj, tmp_path / "import" / "plant")
    shutil.rmtree(tmp_path / "import" / "plant" / "AA39" / "Deflectometry")
    add_photographs(years, tmp_path / "import" / "plant", ["100809", "100810", "100812"])
    with real.client_on(tmp_path, alarm_accuracy=0.999) as client:
        real.run_job(client, "/v1/jobs/imports", folder="plant")
        real.run_job(client, "/v1/jobs/predictions")
        add_photographs(years, tmp_path / "import" / "plant", ["218385"])
        real.run_job(client, "/v1/jobs/imports", folder="plant")
        found = causes_of(client)
    (few,) = [one for one in found if "Too few suns" in one]
    assert "3 photographs under 1 sun," in few
    assert "its accepted photographs have 2" in few
    assert "Plan photographs under other suns" in few


@pytest.mark.full
def test_hazy_day(stj: Path, years: Path, tmp_path: Path):
    """Photographs that arrive one by one, of two mirrors: the first day is hazy for both."""
    folder = tmp_path / "import" / "plant"
    lay_out(stj, folder, ("AA39", "AA40"))
    known = taken(years)
    numbers = [number for number, at in known.items() if at.startswith((HAZY, CLEAR))][::2]
    with real.client_on(tmp_path) as client:
        real.run_job(client, "/v1/jobs/imports", folder="plant")
        for name, haze in (("AA39", 0.8), ("AA40", 0.75)):
            for image in add_photographs(years, tmp_path / name, numbers, name):
                number = image.name.split("-")[0]
                veil(image, haze if known[number].startswith(HAZY) else haze / 20)
                send(client, name, image, known[number])
        found, page = causes_of(client), shown_page(client)
    assert "Haze, or the camera" in found[0], found
    assert f"on {HAZY}" in found[0]
    assert "3 photographs of 1 other heliostat were" in found[0]
    assert any(link.startswith(f"/photographs?since={HAZY}") for link in page.links)


def send(client: TestClient, heliostat: str, image: Path, at: str) -> None:
    """Post a photograph as a camera's sender does."""
    file = image.with_name(image.name.replace("cropped.png", "calibration-properties.json"))
    document = json.loads(file.read_text())
    motors = document["motor_position"]
    answer = poster(client)(
        image.read_bytes(),
        heliostat,
        id=image.name.split("-")[0],
        kind="cropped",
        target=document["target_name"],
        taken_at=at,
        sun={
            "azimuth_deg": azimuth_from_north(document["sun_azimuth"]),
            "elevation_deg": document["sun_elevation"],
        },
        motor_position=[motors["axis_1_motor_position"], motors["axis_2_motor_position"]],
    )
    assert answer.status_code == 201, answer.text


def test_good_heliostat_has_no_causes(real_client: TestClient):
    assert causes_of(real_client) == []
