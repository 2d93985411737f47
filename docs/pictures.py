"""Draw the pictures of README and the site from a demonstration: ``python -m docs.pictures OUT``.

``OUT`` is the folder of ``heliotwin demo``, ``out/demo`` by default. Chromium takes the pages.
"""

import json
import os
import shutil
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from subprocess import PIPE, Popen, run
from tempfile import TemporaryDirectory, gettempdir
from urllib.request import urlopen

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from sqlalchemy import select

from heliotwin.cli import demo
from heliotwin.folder import observations_of
from heliotwin.folder_store import FolderStore
from model.images import FLUX_WINDOW
from model.surface import DEGREE, control_points
from service.base.arrays import unpack
from service.base.settings import Settings
from service.drawing.pictures import mirror_heights, of_peak
from service.sources.folder import MeasuredSurface, read_folder
from service.store.tables import HeliostatRow, SurfaceRow
from service.twin.runtime import Runtime

PICTURE = Path(__file__).parent / "images" / "overview.png"
PHOTOGRAPH = PICTURE.with_name("photograph.jpg")
"""The photograph that README posts."""
NAME, IMAGE = "AB12", "104"
"""The heliostat and its photograph, which no surface was made from."""


def draw(out: Path) -> None:
    """Draw photograph, surface, measured and forecast flux, and field, into `PICTURE`."""
    PICTURE.parent.mkdir(exist_ok=True)
    folder = read_folder(out / "plant")
    settings = Settings(data_dir=out / f"store-{folder.plant.name}", database_url=None)
    runtime = Runtime.from_settings(settings)
    try:
        with runtime.database.reading() as session:
            found, _ = observations_of(FolderStore(folder, runtime, session), NAME)
            query = select(SurfaceRow.arrays).join(
                HeliostatRow, HeliostatRow.id == SurfaceRow.heliostat_id
            )
            query = query.where(HeliostatRow.name == NAME, SurfaceRow.source == "refined")
            z = unpack(session.scalars(query).one())["z"].astype(np.float64)
    finally:
        runtime.close()
    (seen,) = (o for o in found if o.identifier.startswith(IMAGE))
    heliostat = folder.plant.heliostats[NAME]
    mirror = MeasuredSurface(control_points(heliostat, z), DEGREE)
    flux = demo._forecast(heliostat, seen, folder.model, mirror)
    report = json.loads((out / "report.json").read_text(encoding="utf-8"))
    accuracies = {h["heliostat"]: h["accuracy_refined"] for h in report["heliostats"]}
    positions = {name: h.position for name, h in folder.plant.heliostats.items()}

    figure = Figure(figsize=(15, 3.6), layout="constrained", dpi=90)
    axes = figure.subplots(1, 5)
    photograph = cv2.imread(str(next((out / "plant" / NAME).rglob(f"{IMAGE}-raw.png"))))
    cv2.imwrite(str(PHOTOGRAPH), photograph, [cv2.IMWRITE_JPEG_QUALITY, 92])
    axes[0].imshow(photograph[..., ::-1])
    _name(axes[0], "1. Photograph of a target")
    heights = axes[1].imshow(_mirror(z), cmap="RdBu_r", vmin=-1, vmax=1, origin="lower", aspect=0.8)
    figure.colorbar(heights, ax=axes[1], label="mm", shrink=0.7)
    _name(axes[1], "2. Mirror surface")
    measured, forecast = of_peak(seen.flux, flux)
    half = FLUX_WINDOW / 2
    for place, values, title in ((2, measured, "Measured flux"), (3, forecast, "3. Forecast flux")):
        axes[place].imshow(values, cmap="inferno", vmin=0, vmax=1, extent=(-half, half) * 2)
        _name(axes[place], title)
    _draw_field(axes[4], positions, accuracies)
    figure.savefig(PICTURE)


def _mirror(z: np.ndarray) -> np.ndarray:
    """The mirror's four facets as one map [mm], seen from the front, with rows from below."""
    left_up, right_up, left_down, right_down = (
        np.pad(facet.T, 1, constant_values=np.nan) for facet in mirror_heights(z)
    )
    return np.block([[left_down, right_down], [left_up, right_up]])


def _name(axes: Axes, title: str) -> None:
    axes.set_title(title)
    axes.set_xticks([])
    axes.set_yticks([])


def _draw_field(axes: Axes, positions: dict[str, np.ndarray], accuracies: dict[str, float]) -> None:
    """The heliostats around the tower, with the flux accuracy of each."""
    axes.plot(0, 0, "ks", markersize=10)
    axes.annotate("tower", (0, 0), (6, 8), textcoords="offset points")
    for name, (east, north, _) in positions.items():
        axes.plot(east, north, "o", color="#2a7f62", markersize=9)
        axes.annotate(
            f"{name}\n{accuracies[name]:.0%}", (east, north), (7, -8), textcoords="offset points"
        )
    axes.margins(0.3)
    axes.set_aspect("equal")
    _name(axes, "4. Field: flux accuracy")


def draw_second_plant(out: Path) -> None:
    """Copy the pictures of a plant and its flux, and take the page of a photographed heliostat."""
    for name in ("plant", "field"):
        shutil.copyfile(out / f"{name}.png", PICTURE.with_name(f"second-{name}.png"))
    report = json.loads((out / "report.json").read_text(encoding="utf-8"))
    name = report["heliostats"][0]["heliostat"]
    with _served(out / "store-southern"):
        _take_page(f"/heliostats/{name}", "second-heliostat", 1900)


def draw_console(out: Path) -> None:
    """Take pages of the field with faults, after all that they show is computed."""
    with _served(out / "store-field") as address:
        while json.load(urlopen(f"{address}/v1/alarms"))["pending"]:
            time.sleep(1)
        _take_page("/", "console-field", 1000)
        _take_page("/alarms", "console-alarms", 1150)
        _take_page("/heliostats/R04-12", "console-heliostat", 1330)


@contextmanager
def _served(store: Path) -> Iterator[str]:
    """The address of a service on a store, by a link that names no folder of this machine."""
    serve = [sys.executable, "-m", "service", "serve", "--port", str(PORT), "--json"]
    LINK.unlink(missing_ok=True)
    LINK.symlink_to(store.resolve())
    environment = os.environ | {"HELIOTWIN_DATA_DIR": str(LINK)}
    with Popen(serve, env=environment, stdout=PIPE) as service:
        try:
            assert service.stdout is not None
            service.stdout.readline()  # it is written once the service listens
            yield f"http://127.0.0.1:{PORT}"
        finally:
            service.terminate()
            LINK.unlink()


def _take_page(path: str, name: str, height: int) -> None:
    """Take a page of the service, 1280 pixels wide; the second time all that it shows is known."""
    with TemporaryDirectory() as folder:
        picture = Path(folder) / "page.png"
        for _ in range(2):
            run(
                ["chromium", "--headless", "--no-sandbox", "--hide-scrollbars",
                 "--virtual-time-budget=20000", f"--window-size=1440,{height}",
                 f"--screenshot={picture}", f"http://127.0.0.1:{PORT}{path}"],
                check=True, capture_output=True,
            )  # fmt: skip
        quality = [cv2.IMWRITE_JPEG_QUALITY, 80]
        cv2.imwrite(str(PICTURE.with_name(f"{name}.jpg")), cv2.imread(str(picture)), quality)


PORT = 8123
LINK = Path(gettempdir()) / "heliotwin-data"

if __name__ == "__main__":
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "out/demo")
    draw(folder)
    draw_second_plant(folder / "southern")
    draw_console(folder)
