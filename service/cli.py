"""The command ``heliotwin``."""

import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from pydantic import ValidationError
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

from model.errors import InvalidInputError, ModelError
from service.cli_keys import keys_app
from service.cli_models import models_app
from service.cli_recovery import backup, check, restore
from service.faults import ServiceError
from service.operations import Method
from service.paint import MeasurementFolder, read_folder

# Tables and progress go to standard error, so that --json leaves standard output to the report.
console = Console(stderr=True)

app = typer.Typer(
    name="heliotwin",
    help="From a solar tower's target photographs to mirror surfaces and flux forecasts.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

Folder = Annotated[Path, typer.Argument(help="Measurement folder in PAINT's layout.", metavar="DIR")]
Out = Annotated[Path, typer.Option("--out", help="Folder to write to.", metavar="OUT")]
Surfaces = Annotated[str, typer.Option(help="measured, ideal, or a folder that predict wrote.")]
EffectsFile = Annotated[
    Path | None,
    typer.Option("--effects", help="Effects to add to the declared ones: JSON, or a study's report.", metavar="FILE"),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print the report as JSON on standard output.")]


@contextmanager
def progress(total: int | None, label: str) -> Iterator[Any]:
    """A progress bar; yields a callback that takes the name of what is being done."""
    columns = (SpinnerColumn(), TextColumn("{task.description:<40}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(label, total=total)

        def step(name: str) -> None:
            bar.update(task, description=f"{label} {name}", advance=1)

        yield step


def show(report: dict[str, Any], as_json: bool, table: Table | None = None) -> None:
    """Print the report: JSON, or its table and what was skipped."""
    if as_json:
        typer.echo(json.dumps(report, indent=1))
        return
    if table is not None:
        Console().print(table)
    for name, reason in report.get("skipped", {}).items():
        console.print(f"skipped {name}: {reason}", style="yellow", highlight=False)


def _count(folder: MeasurementFolder, with_images: bool = True) -> int:
    return sum(len(folder.measurements(name, with_images)) for name in folder.plant.heliostats)


def make_table(title: str, *columns: str) -> Table:
    """An empty table; all columns but the first hold numbers."""
    table = Table(title=title, title_justify="left")
    for index, column in enumerate(columns):
        table.add_column(escape(column), justify="left" if index == 0 else "right")
    return table


@app.command()
def flux(folder: Folder, out: Out, as_json: AsJson = False) -> None:
    """Camera frames or crops to flux images: OUT/H/ID-flux.png, ID-flux-centered.npz, quality.json."""
    from service.folder import flux_folder

    source = read_folder(folder)
    with progress(_count(source), "flux") as step:
        report = flux_folder(source, out, step)
    table = make_table("Quality", "image", "accepted", "reason", "signal/background", "outside 4 m")
    for key, entry in report["images"].items():
        table.add_row(
            key,
            "yes" if entry["accepted"] else "no",
            entry["reason"] or "",
            f"{entry['signal_to_background']:.1f}",
            f"{entry['energy_outside_window']:.3f}",
        )
    show(report, as_json, table)


@app.command()
def predict(
    folder: Folder,
    out: Out,
    method: Annotated[
        str, typer.Option(help="network, or refined: the network, then MAP through the tracer.")
    ] = "network",
    images: Annotated[int, typer.Option(help="Most images used for a heliostat, 1 to 8.")] = 8,
    as_json: AsJson = False,
) -> None:
    """Mirror surfaces from images: OUT/H/Deflectometry/H-nurbs-surface.npz and OUT/predictions.json."""
    from service.folder import predict_folder

    if method not in ("network", "refined"):
        raise InvalidInputError(f"--method must be 'network' or 'refined', got {method!r}")
    chosen: Method = "network" if method == "network" else "refined"
    source = read_folder(folder)
    with progress(len(source.plant.heliostats), "predict") as step:
        report = predict_folder(source, out, chosen, images, step)
    table = make_table("Surfaces", "heliostat", "images", "misfit", "rms [mm]", "error to measured [mm]")
    for name, entry in report["heliostats"].items():
        error = entry.get("against_measured", {}).get("mae_mm")
        table.add_row(
            name,
            str(len(entry["images"])),
            f"{entry['misfit']:.3f}",
            f"{entry['z_rms_mm']:.3f}",
            "" if error is None else f"{error:.3f}",
        )
    show(report, as_json, table)


@app.command()
def forecast(
    folder: Folder,
    out: Out,
    surfaces: Surfaces = "measured",
    effects: EffectsFile = None,
    window: Annotated[
        float | None, typer.Option(help="Side [m] of the accuracy's window; by the spot if not given.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Flux on the whole target for each measurement [W/m2]: OUT/H/ID-forecast.npz and OUT/forecast.json."""
    from service.folder import forecast_folder
    from service.paint import read_effects

    added = () if effects is None else read_effects(effects)
    source = read_folder(folder)
    with progress(_count(source, with_images=False), "forecast") as step:
        report = forecast_folder(source, out, surfaces, window, step, added)
    table = make_table("Forecasts", "measurement", "accuracy", "window [m]", "outside", "peak [kW/m2]")
    for key, entry in report["measurements"].items():
        compared = "accuracy" in entry
        table.add_row(
            key,
            f"{entry['accuracy']:.3f}" if compared else "",
            f"{entry['window']:.0f}" if compared else "",
            f"{entry['measured_outside']:.3f}" if compared else "",
            f"{entry['peak_w_m2'] / 1000:.2f}",
        )
    if report["accuracy_mean"] is not None:
        table.add_section()
        table.add_row("mean", f"{report['accuracy_mean']:.3f}")
    show(report, as_json, table)


@app.command()
def study(
    folder: Folder,
    out: Annotated[Path, typer.Option("--out", help="JSON file to write the report to.", metavar="REPORT.json")],
    page: Annotated[
        Path | None, typer.Option("--html", help="Write the report as one web page, too.", metavar="FILE")
    ] = None,
    surfaces: Surfaces = "measured",
    effects: EffectsFile = None,
    as_json: AsJson = False,
) -> None:
    """Which physical effect the photographs demand that the declared model lacks, and what it buys: REPORT.json."""
    from service.folder import write_json
    from service.paint import read_effects
    from service.study import study_folder

    for path in filter(None, (out, page)):
        if path.is_dir():
            raise InvalidInputError(f"{path} is a folder; name a file to write to")
    added = () if effects is None else read_effects(effects)
    source = read_folder(folder)
    with progress(None, "study") as step:
        done = study_folder(source, surfaces, effects=added, progress=step)
    report = done.to_json()
    write_json(out, report)
    if page is not None:
        from service.study_page import study_page

        page.parent.mkdir(parents=True, exist_ok=True)
        page.write_text(study_page(done.study, folder.resolve().name, done.skipped), encoding="utf-8")
    show(report, as_json, _study_table(report))
    if not as_json:
        typer.echo(done.study.conclusion())


def _study_table(report: dict[str, Any]) -> Table:
    """Every candidate alone, the best first, and where the model stands before and after."""
    table = make_table(f"Study: {report['verdict']}", "effect", "accuracy", "gain, 95 %", "score", "")
    found = {effect["name"] for effect in report["effects"]}
    for candidate in report["candidates"]:
        low, high = candidate["accuracy_gain"]["ci95"]
        accuracy, score = f"{candidate['accuracy_after']:.3f}", f"{candidate['score']:.1f}"
        mark = "found" if candidate["name"] in found else ""
        table.add_row(candidate["name"], accuracy, f"{low:.3f} to {high:.3f}", score, mark)
    table.add_section()
    for name in ("before", "after"):
        table.add_row(f"all, {name}", f"{report[name]['accuracy_mean']:.3f}")
    return table


@app.command("import")
def import_(folder: Folder, as_json: AsJson = False) -> None:
    """A measurement folder into the store; a second run changes nothing."""
    from service.importer import import_folder
    from service.runtime import Runtime
    from service.settings import Settings

    source = read_folder(folder)
    runtime = Runtime.from_settings(Settings())
    try:
        if runtime.settings.migrates_on_start:
            runtime.database.upgrade()
        with progress(None, "import") as step:
            report = import_folder(runtime, source, step)
    finally:
        runtime.close()
    table = make_table("Imported", "what", "count")
    for what, count in report["counts"].items():
        table.add_row(what, str(count))
    show(report, as_json, table)


@app.command()
def serve(
    host: Annotated[str | None, typer.Option(help="Address to listen on; HELIOTWIN_HOST or 127.0.0.1.")] = None,
    port: Annotated[int | None, typer.Option(help="Port to listen on; HELIOTWIN_PORT or 8000.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print where it listens as JSON before it starts.")] = False,
) -> None:
    """The REST service, on an embedded SQLite store unless HELIOTWIN_DATABASE_URL names another."""
    from service import server
    from service.settings import Settings

    given: dict[str, Any] = {key: value for key, value in {"host": host, "port": port}.items() if value is not None}
    settings = Settings(**given)
    address = f"http://{settings.host}:{settings.port}"
    if as_json:
        typer.echo(json.dumps({"url": address, "docs": f"{address}/docs"}))
    else:
        console.print(f"heliotwin listens on {address}, its documentation on {address}/docs")
    server.serve(settings)


@app.command()
def worker(
    count: Annotated[int | None, typer.Option(help="Jobs at a time; HELIOTWIN_JOB_WORKERS or 1.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print what it works at as JSON before it starts.")] = False,
) -> None:
    """Work at the jobs of the store that `serve` uses, in a process of its own."""
    from service.handlers import KINDS
    from service.settings import Settings
    from service.workers import work

    settings = Settings() if count is None else Settings(job_workers=count)
    if as_json:
        typer.echo(json.dumps({"workers": settings.job_workers}))
    work(settings, KINDS)


@app.command()
def migrate(
    to: Annotated[
        str, typer.Option(help="An older revision to go back to; what only newer ones can hold is lost.")
    ] = "head",
    as_json: AsJson = False,
) -> None:
    """Bring the database to its newest schema, or back to an older one."""
    from service import server
    from service.settings import Settings

    settings = Settings()
    settings.data_dir.mkdir(parents=True, exist_ok=True)
    report = {"revision": server.migrate(settings, to)}
    show(report, as_json)
    console.print(f"the schema stands at {report['revision']}", highlight=False)


@app.command()
def demo(
    data: Annotated[Path | None, typer.Option(help="A measurement folder instead of the embedded plant.")] = None,
    out: Annotated[Path, typer.Option(help="Folder to write to.")] = Path("out/demo"),
    as_json: AsJson = False,
) -> None:
    """The main job on an embedded plant, or on a measurement folder, with pictures and a report."""
    from service.demo import run_demo

    show(run_demo(data, out, console, quiet=as_json), as_json)


for _command in (backup, restore, check):
    app.command()(_command)
app.add_typer(keys_app)
app.add_typer(models_app)


def main() -> None:
    """Run the command; bad input ends with exit code 2 and one line, other failures of the model with 1."""
    try:
        app()
    except InvalidInputError as error:
        _fail(error, 2)
    except ValidationError as error:
        first = error.errors()[0]
        _fail(f"setting {'.'.join(map(str, first['loc'])) or 'combination'}: {first['msg']}", 2)
    except (ModelError, ServiceError, OSError) as error:
        _fail(error, 1)


def _fail(error: object, code: int) -> None:
    typer.echo(f"heliotwin: {error}", err=True)
    sys.exit(code)


if __name__ == "__main__":
    main()
