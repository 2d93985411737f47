"""The demonstration: from photographs to stored surfaces, flux forecasts, a table and pictures."""

import shlex
import shutil
import sys
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from heliotwin.cli.output import make_table
from heliotwin.demo.described import Demonstrated, write_southern_plant
from heliotwin.demo.field_store import ACTOR, run_job, seed_field
from heliotwin.demo.plant import POSITIONS, write_plant
from heliotwin.field import FieldReport, FieldRequest, trace_field
from heliotwin.folder import observations_of, surface_errors, write_json
from heliotwin.folder_store import FolderStore
from model.errors import InvalidInputError, ModelError
from model.frames import SunAngles, sun_angles
from model.images import FLUX_SIZE
from model.imaging.window import center_of_mass, flux_window
from model.metrics import flux_accuracy
from model.network.architecture import MAX_IMAGES
from model.observation import Observation
from model.plant import Heliostat
from model.plant_model import PlantModel
from model.setup import Setup
from model.surface import DEGREE, control_points
from service.base.arrays import unpack
from service.base.choices import Method, Selection
from service.base.errors import ConflictError, list_reasons
from service.base.fields import Sun
from service.base.progress import no_progress
from service.base.settings import Settings
from service.drawing.facets import FacetPlaces
from service.drawing.pictures import (
    comparison_picture,
    flux_picture,
    of_peak,
    plant_picture,
    surface_picture,
)
from service.drawing.templates import ASSETS, TEMPLATES
from service.jobs.kinds import camera_choices
from service.sources.folder import MeasuredSurface, MeasurementFolder, measured_heights, read_folder
from service.sources.plant_file import read_plant
from service.sources.plant_formats.imported import PLANT
from service.store import add_study as store_study
from service.twin import operations
from service.twin.forecasts.heliostat_forecast import make_forecast
from service.twin.forecasts.requests import ForecastIn
from service.twin.importing import import_folder
from service.twin.measurements import choose_diverse
from service.twin.runtime import Runtime
from service.twin.studies.study import StudyIn, study_row, study_store
from service.twin.surfaces.prediction import predict_surface

Array = NDArray[np.float64]

HELD_OUT = 4
"""Every fourth image is held out from the prediction, to test it."""


@dataclass(frozen=True)
class HeliostatResult:
    """Results for one heliostat: mean accuracies over the test images, surface errors in mm.

    ``held_out`` is False if the test images were also used for the prediction, because there are
    too few images. ``accuracy_network`` is None for mirrors that no network predicts.
    """

    heliostat: str
    used: int
    judged: int
    held_out: bool
    accuracy_ideal: float
    accuracy_network: float | None
    accuracy_refined: float
    accuracy_measured: float | None
    error_network_mm: float | None
    error_refined_mm: float | None
    pictures: tuple[str, ...]


def run_demos(
    data: Path | None, plant: Path | None, out: Path, console: Console, has_field: bool = True
) -> Mapping[str, object]:
    """Run the demonstration on a folder, on photographs of a plant's file, or on embedded plants.

    The embedded plants are one of Juelich's kind, in ``out``, and one of another, in
    ``out/southern``. With ``has_field`` a third one follows, to look at: a field with faults in
    ``out/store-field``. A plant of a file is demonstrated in a folder of its name.

    Returns
    -------
    mapping
        The report of the first plant; that of the second one is under ``other_plant``.
    """
    if data is not None and plant is not None:
        raise InvalidInputError("--data, --plant: give one of them")
    if data is not None:
        return run_demo(data, out, console)
    if plant is not None:
        return _demonstrate(plant, out, console)
    root = out / "plant"
    parts = 3 if has_field else 2
    _announce(console, f"1 of {parts}: four mirrors of Juelich's kind, about 1 minute")
    with _bars(console) as bars:
        write_plant(root, _counting(bars, "photograph a plant", len(POSITIONS)))
    report = run_demo(root, out, console)
    _announce(console, f"2 of {parts}: two mirrors of 28 facets, about 1 minute more")
    with TemporaryDirectory(prefix="heliotwin-") as folder:
        file = write_southern_plant(Path(folder))
        other = _demonstrate(file, out, console)
    if has_field:
        _announce(console, "3 of 3: 200 heliostats, some with faults, about 2 minutes more")
        store = out / "store-field"
        with _bars(console) as bars:
            seed_field(out / "plant-field", store, partial(_counting, bars, "a field with faults"))
        _print_next(console, "a field of 200 heliostats with faults, to look at its pages", store)
    return {**report, "other_plant": other}


def _announce(console: Console, part: str) -> None:
    """Say which part of the demonstration begins, and how long it takes on two cores."""
    console.print(f"\n{part}", style="bold", highlight=False)


def _demonstrate(plant: Path, out: Path, console: Console) -> Mapping[str, object]:
    """Photograph a plant that a file describes, and run the demonstration on it, in a folder of its
    name.
    """
    demonstrated = Demonstrated.read(plant)
    out = out / demonstrated.description.plant.name
    with _bars(console) as bars:
        counting = _counting(bars, "photograph a plant", len(demonstrated.mirrors))
        demonstrated.write(out / "plant", counting)
    return run_demo(out / "plant", out, console)


def _counting(bars: Progress, what: str, total: int) -> Callable[[str], None]:
    """Progress of a part with so many steps."""
    task = bars.add_task(what, total=total)
    return lambda name: bars.update(task, description=f"{what}: {name}", advance=1)


def run_demo(root: Path, out: Path, console: Console) -> Mapping[str, object]:
    """Run the demonstration on a measurement folder.

    All files are written to ``out``. Return the report.
    """
    out.mkdir(parents=True, exist_ok=True)
    with _bars(console) as bars:
        folder = read_folder(root)
        # A store holds one plant: each plant has a separate store, so that demonstrations on
        # different data can share one folder.
        store = out / f"store-{folder.plant.name}"
        with closing(_open_store(store)) as runtime:
            count = sum(
                len(m.images) for name in folder.plant.heliostats for m in folder.measurements(name)
            )
            whole = read_folder(root, whole_field=True)
            task = bars.add_task("import", total=count + len(whole.plant.heliostats))
            imported = import_folder(
                runtime, whole, lambda name: bars.update(task, description=name, advance=1)
            )
            camera = _declare_camera(runtime)
            made, skipped = _predict_all(runtime, folder, bars)
            if not made:
                reasons = list_reasons(skipped)
                raise ModelError(
                    f"{root}: no heliostat had an image that could be used ({reasons})"
                )
            study = _study(runtime, bars)
    field = _trace_field(root, out)
    results = _drawn(out, made, runtime.settings.figure_scales)
    report: dict[str, object] = {
        "data": str(root),
        "store": imported["counts"],
        "camera": camera,
        "heliostats": [asdict(result) for result in results],
        "study": study,
        "field": field,
        "skipped": {**skipped, **imported["skipped"]},
    }
    write_json(out / "report.json", report)
    (out / "report.html").write_text(_page(report, results), encoding="utf-8")
    if camera is not None:
        console.print(f"camera: {camera}", highlight=False)
    _print(console, results, study["conclusion"], out, store)
    return report


def _declare_camera(runtime: Runtime) -> str | None:
    """Declare images without background as sRGB counts if forecasts say so; return what they say.

    An operator does the same when the service's alarm offers it. None: there are too few images.
    """
    with runtime.database.reading() as session:
        if camera_choices.due(session, runtime.settings) is None:
            return None
    chosen = run_job(runtime, "camera-choices").result or {}
    if chosen["answer"] == "srgb":
        run_job(runtime, "measurements", camera="srgb", reason="forecasts fit them so")
    return chosen.get("in_words")


def _study(runtime: Runtime, bars: Progress) -> dict[str, str | None]:
    """Study all photographs, store the study, and return its verdict and conclusion.

    Without a verdict, the conclusion says why none was possible.
    """
    task = bars.add_task("study what the model lacks", total=1)
    try:
        studied = study_store(runtime, StudyIn())
    except ConflictError as error:
        return {"verdict": None, "conclusion": str(error)}
    row = study_row(
        studied, "Study of the demonstration", {}, ACTOR, runtime.settings.figure_scales
    )
    with runtime.database.writing() as session:
        store_study(session, row)
    bars.update(task, advance=1)
    return {"verdict": row.verdict, "conclusion": row.conclusion}


def _trace_field(root: Path, out: Path) -> FieldReport | None:
    """Trace the field of a plant's file at noon of an equinox, if it has a receiver.

    Files: ``OUT/field/field.json``, ``OUT/plant.png`` and ``OUT/field.png``.
    """
    file = root / PLANT
    described = read_plant(file) if file.is_file() else None
    if described is None or not described.receivers:
        return None
    (out / "plant.png").write_bytes(
        plant_picture(described.plant, described.receivers, described.type_of, described.tower)
    )
    receiver = next(iter(described.receivers.values()))
    latitude = float(described.plant.origin[0])
    noon = SunAngles(180.0 if latitude >= 0 else 0.0, 90.0 - abs(latitude))
    request = FieldRequest(receiver.name, noon.azimuth, noon.elevation)
    found = trace_field(described, request, no_progress)
    write_json(out / "field" / "field.json", found.report)
    size = receiver.width, receiver.height
    title = f"{described.plant.name}, {receiver.name}: noon of an equinox"
    (out / "field.png").write_bytes(flux_picture(found.flux / 1e3, size, "kW/m2", title))
    return found.report


def _bars(console: Console) -> Progress:
    columns = (
        TextColumn("{task.description:<34}"),
        BarColumn(),
        TextColumn("{task.completed}/{task.total}"),
    )
    return Progress(*columns, TimeElapsedColumn(), console=console)


def _open_store(folder: Path) -> Runtime:
    runtime = Runtime.from_settings(Settings(data_dir=folder, database_url=None, host="127.0.0.1"))
    runtime.database.upgrade()
    return runtime


@dataclass(frozen=True, eq=False)
class _Made:
    """A result with its mirror, surfaces (F, 8, 8) [m], test images and refined forecasts."""

    result: HeliostatResult
    heliostat: Heliostat
    surfaces: dict[str, Array | None]
    judged: list[Observation]
    forecasts: list[Array]


def _predict_all(runtime: Runtime, folder: MeasurementFolder, bars: Progress) -> Selection[_Made]:
    """Predict in two threads; results in the order of the heliostats."""
    done = _counting(bars, "predict and forecast", len(folder.plant.heliostats))

    def predict(name: str) -> _Made | str:
        with runtime.database.reading() as session:
            usable, refused = observations_of(FolderStore(folder, runtime, session), name)
        result = (
            _predict(runtime, folder, name, usable)
            if usable
            else next(iter(refused.values()), "no image")
        )
        done(name)
        return result

    with ThreadPoolExecutor(2) as pool:
        found = dict(
            zip(folder.plant.heliostats, pool.map(predict, folder.plant.heliostats), strict=True)
        )
    return Selection(
        [one for one in found.values() if not isinstance(one, str)],
        {name: one for name, one in found.items() if isinstance(one, str)},
    )


def _split(observations: list[Observation]) -> tuple[list[Observation], list[Observation]]:
    """Split into images to predict from and test images.

    With fewer than `HELD_OUT` images, both lists are the same.
    """
    if len(observations) < HELD_OUT:
        return observations, observations
    judged = observations[HELD_OUT - 1 :: HELD_OUT]
    used = [o for o in observations if not any(o is j for j in judged)]
    return choose_diverse(used, MAX_IMAGES), judged


def _stored(
    runtime: Runtime, name: str, method: Method, used: Sequence[Observation]
) -> dict[str, Array]:
    """Predict from stored measurements and store the version; return its heights (F, 8, 8) [m].

    The key is the method. Mirrors that no network predicts are refined. For few images "refined"
    is the network's surface, where it agrees better with them.
    """
    row = predict_surface(runtime, name, method, [o.identifier for o in used]).row
    key = "refined" if method == "refined" else row.source
    return {key: unpack(row.arrays)["z"].astype(np.float64)}


def _predict(
    runtime: Runtime, folder: MeasurementFolder, name: str, observations: list[Observation]
) -> _Made:
    heliostat = folder.plant.heliostats[name]
    used, judged = _split(observations)
    surfaces: dict[str, Array | None] = {"ideal": None}
    surfaces |= _stored(runtime, name, "network", used)
    if "refined" not in surfaces:
        surfaces |= _stored(runtime, name, "refined", used)
    _store_forecast(runtime, name, judged[0])
    mirrors = {
        key: MeasuredSurface(control_points(heliostat, z), DEGREE) for key, z in surfaces.items()
    }
    errors: dict[str, dict[str, float]] = {}
    measured = folder.measured_surface(name)
    if measured is not None:
        mirrors["measured"] = measured
        truth = measured_heights(heliostat, measured)
        errors = {key: surface_errors(z, truth) for key, z in surfaces.items() if z is not None}
        surfaces["measured"] = truth
    fluxes = {
        key: [_forecast(heliostat, o, folder.model, mirror) for o in judged]
        for key, mirror in mirrors.items()
    }
    accuracies = {
        key: float(np.mean([flux_accuracy(o.flux, f) for o, f in zip(judged, images, strict=True)]))
        for key, images in fluxes.items()
    }
    result = HeliostatResult(
        heliostat=name,
        used=len(used),
        judged=len(judged),
        held_out=len(observations) >= HELD_OUT,
        accuracy_ideal=accuracies["ideal"],
        accuracy_network=accuracies.get("network"),
        accuracy_refined=accuracies["refined"],
        accuracy_measured=accuracies.get("measured"),
        error_network_mm=errors.get("network", {}).get("mae_mm"),
        error_refined_mm=errors.get("refined", {}).get("mae_mm"),
        pictures=(),
    )
    return _Made(result, heliostat, surfaces, judged, fluxes["refined"])


def _store_forecast(runtime: Runtime, name: str, observation: Observation) -> None:
    """Store one forecast, as the calibration system would request it."""
    azimuth, elevation = sun_angles(observation.sun)
    request = ForecastIn(
        heliostat=name,
        sun=Sun(azimuth_deg=float(azimuth), elevation_deg=float(elevation)),
        target=observation.target.name,
    )
    make_forecast(runtime, request)


def _forecast(
    heliostat: Heliostat, observation: Observation, model: PlantModel, mirror: MeasuredSurface
) -> Array:
    """Forecast (64, 64) in the window of an observation, centered on the forecast's centroid.

    The flux is traced in a wider window first, because the centroid of the image differs slightly
    from the centroid of its rays.
    """
    side, spot = observation.side, observation.center_of_mass
    wide = 1.5 * side
    sun, target, degree = observation.sun, observation.target, mirror.degree
    setup = Setup(heliostat, mirror.points, sun, target, spot, degree=degree)
    traced = operations.forecast(setup, model, (96, 96), wide)
    center = center_of_mass(traced.camera_view, (wide, wide))
    return flux_window(traced.camera_view, (wide, wide), center, side, FLUX_SIZE)


def _drawn(out: Path, made: Sequence[_Made], ends: Mapping[str, float]) -> list[HeliostatResult]:
    """Results with their pictures, all on the same scales.

    ``ends`` are the scales of the settings.
    """
    pairs = [
        of_peak(o.flux, flux)
        for one in made
        for o, flux in zip(one.judged, one.forecasts, strict=True)
    ]
    top = max(float(image.max()) for pair in pairs for image in pair)
    return [replace(one.result, pictures=_draw(out, one, top, ends)) for one in made]


def _draw(out: Path, made: _Made, top: float, ends: Mapping[str, float]) -> tuple[str, ...]:
    """Draw surface maps, and measured and forecast flux of each test image.

    Return the paths of the pictures, relative to ``out``.
    """
    name = made.result.heliostat
    drawn = {
        f"surfaces/{name}-{key}.png": surface_picture(
            z, f"{name}, {key}", ends["heights"], FacetPlaces.of(made.heliostat)
        )
        for key, z in made.surfaces.items()
        if z is not None
    }
    for observation, flux in zip(made.judged, made.forecasts, strict=True):
        title = (
            f"{name}/{observation.identifier}: accuracy {flux_accuracy(observation.flux, flux):.1%}"
        )
        bounds = top, ends["flux_difference"]
        picture = comparison_picture(observation.flux, flux, observation.side, title, bounds)
        drawn[f"flux/{name}-{observation.identifier}.png"] = picture
    for path, content in drawn.items():
        (out / path).parent.mkdir(parents=True, exist_ok=True)
        (out / path).write_bytes(content)
    return tuple(drawn)


def _cell(value: float | None) -> str:
    return "" if value is None else f"{value:.3f}"


COLUMNS = ("name", "images", "ideal", "network", "refined", "measured", "net. mm", "ref. mm")
CAPTION = (
    "images: those predicted from + those kept to judge by; without + they are the same. ideal to"
    " measured: flux accuracy with that surface; mm: error of the network's and the refined surface"
    " against the measured one"
)


def _row(result: HeliostatResult) -> Sequence[str]:
    images = f"{result.used} + {result.judged}" if result.held_out else str(result.used)
    figures = (
        result.accuracy_ideal,
        result.accuracy_network,
        result.accuracy_refined,
        result.accuracy_measured,
        result.error_network_mm,
        result.error_refined_mm,
    )
    return (result.heliostat, images, *map(_cell, figures))


def _print(
    console: Console, results: list[HeliostatResult], study: str | None, out: Path, store: Path
) -> None:
    table = make_table("What the surfaces are worth", *COLUMNS)
    table.caption, table.caption_justify = CAPTION, "left"
    for result in results:
        table.add_row(*_row(result))
    console.print(table)
    console.print(f"study: {study}", highlight=False)
    console.print(f"pictures and report: {out / 'report.html'}", highlight=False)
    _print_next(console, "next, the service on what was made", store)


def _print_next(console: Console, what: str, store: Path) -> None:
    """Print a command that serves a store.

    A person can paste the line: it has the full path if the command is not on the PATH.
    """
    beside = str(Path(sys.executable).with_name("heliotwin"))
    command = "heliotwin" if shutil.which("heliotwin") else shlex.quote(beside)
    console.print(f"{what}:", highlight=False)
    said = f"HELIOTWIN_DATA_DIR={shlex.quote(str(store))} {command} serve"
    console.print(said, highlight=False, markup=False, soft_wrap=True)


def _page(report: Mapping[str, object], results: list[HeliostatResult]) -> str:
    """HTML page with a conclusion, the table and links to the pictures."""
    judging = [result for result in results if result.held_out] or results
    photographs = sum(result.judged for result in judging)
    accuracies = {key: _mean_accuracy(judging, key) for key in ("ideal", "network", "refined")}
    return TEMPLATES.get_template("demo.html").render(
        style=Markup(ASSETS.joinpath("app.css").read_text(encoding="utf-8")),
        **report,
        results=results,
        accuracies=accuracies,
        photographs=photographs,
        is_unseen=judging[0].held_out,
        errors_mm=[
            result.error_refined_mm for result in results if result.error_refined_mm is not None
        ],
    )


def _mean_accuracy(results: Sequence[HeliostatResult], surface: str) -> float | None:
    """Mean accuracy with a surface over all photographs; None if no result has it."""
    known = [
        (accuracy, result.judged)
        for result in results
        if (accuracy := getattr(result, f"accuracy_{surface}")) is not None
    ]
    total = sum(judged for _, judged in known)
    return sum(accuracy * judged for accuracy, judged in known) / total if total else None
