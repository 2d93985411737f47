"""Verbs that run the service or fill its store: serve, worker, migrate, import, export, demo."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from heliotwin.cli.output import (
    AsJson,
    console,
    make_table,
    progress,
    require_folder,
    require_unbroken,
    show,
)
from heliotwin.cli.store import actor, keep_private, open_runtime
from heliotwin.cli.verbs.photographs import Folder

app = typer.Typer()


@app.command("import")
def import_(folder: Folder, as_json: AsJson = False) -> None:
    """Import a measurement folder into the store; a second run changes nothing."""
    from service.sources.folder import read_folder
    from service.twin.importing import import_folder

    keep_private()
    source = read_folder(folder, whole_field=True)
    with open_runtime(is_new=True) as runtime, progress(None, "import") as step:
        report = import_folder(runtime, source, step, actor())
    _show_counts("Imported", report, as_json)
    require_unbroken(source)


@app.command()
def export(
    folder: Annotated[Path, typer.Argument(help="A new folder to write to.", metavar="DIR")],
    as_json: AsJson = False,
) -> None:
    """Export the store as a measurement folder in PAINT's layout, with STAC items.

    `heliotwin import` reads it.
    """
    from service.twin.exporting import export_folder

    with open_runtime() as runtime, progress(None, "export") as step:
        report = export_folder(runtime, folder, step)
    _show_counts("Exported", report, as_json)


def _show_counts(title: str, report: Mapping[str, Any], as_json: bool) -> None:
    table = make_table(title, "what", "count")
    for what, count in report["counts"].items():
        table.add_row(what, str(count))
    show(report, as_json, table)


@app.command()
def serve(
    host: Annotated[
        str | None, typer.Option(help="Address to listen on; HELIOTWIN_HOST or 127.0.0.1.")
    ] = None,
    port: Annotated[
        int | None, typer.Option(help="Port to listen on; HELIOTWIN_PORT or 8000.")
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print where it listens as JSON, once it does.")
    ] = False,
) -> None:
    """Run the REST service, on an embedded SQLite store unless HELIOTWIN_DATABASE_URL names
    another.
    """
    from service.base.settings import Settings
    from service.web.app import serve as serve_app

    keep_private()
    given = {"host": host, "port": port}
    settings = Settings.model_validate({k: v for k, v in given.items() if v is not None})
    address = f"http://{settings.host}:{settings.port}"

    def say() -> None:
        if as_json:
            typer.echo(json.dumps({"url": address, "docs": f"{address}/docs"}))
        else:
            console.print(f"heliotwin listens on {address}, its documentation on {address}/docs")

    serve_app(settings, say)


@app.command()
def worker(
    count: Annotated[
        int | None, typer.Option(help="Jobs at a time; HELIOTWIN_JOB_WORKERS or 1.")
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print what it works at as JSON before it starts.")
    ] = False,
) -> None:
    """Run the jobs of the store that `serve` uses, in a separate process."""
    from service.base.settings import Settings
    from service.jobs.kinds import KINDS
    from service.jobs.worker import work

    keep_private()
    settings = Settings() if count is None else Settings(job_workers=count)
    if as_json:
        typer.echo(json.dumps({"workers": settings.job_workers}))
    work(settings, KINDS)


@app.command()
def migrate(as_json: AsJson = False) -> None:
    """Bring the database to its newest schema."""
    from service.base.settings import Settings
    from service.store import database

    keep_private()
    settings = Settings()
    settings.data_dir.mkdir(parents=True, exist_ok=True)
    report = {"revision": database.migrate(settings)}
    show(report, as_json)
    console.print(f"the schema is at {report['revision']}", highlight=False)


@app.command()
def demo(
    data: Annotated[
        Path | None, typer.Option(help="A measurement folder instead of the embedded plants.")
    ] = None,
    plant: Annotated[
        Path | None,
        typer.Option(
            help="A plant's file: some of its mirrors are photographed.", metavar="PLANT.yaml"
        ),
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder to write to.")] = Path("out/demo"),
    field: Annotated[
        bool,
        typer.Option(help="Also fill a store of 200 heliostats with faults, to look at its pages."),
    ] = True,
    as_json: AsJson = False,
) -> None:
    """Run the main job, with pictures and a report, on two embedded plants, a plant's file or a
    measurement folder.

    After the embedded plants, a field with faults follows.
    """
    from heliotwin.cli.demo import run_demos

    require_folder(out)
    said = Console(stderr=True, quiet=as_json)
    show(run_demos(data, plant, out, said, has_field=field), as_json)
