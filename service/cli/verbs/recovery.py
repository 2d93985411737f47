"""The commands ``heliotwin backup``, ``restore`` and ``check``."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

from service.cli.output import AsJson, console

app = typer.Typer()

New = Annotated[Path, typer.Argument(help="A new folder to write the back-up to.", metavar="FOLDER")]
Old = Annotated[Path, typer.Argument(help="A folder that `heliotwin backup` wrote.", metavar="FOLDER")]


@contextmanager
def _showing(what: str) -> Iterator[Any]:
    with console.status(what) as status:
        yield lambda name: status.update(f"{what} {name}")


@app.command()
def backup(folder: New, as_json: AsJson = False) -> None:
    """Write database and images to a new folder, consistent while the service runs; exit code 1 if an image is bad."""
    from service.base.settings import Settings
    from service.store.backup import back_up

    with _showing("backup") as step:
        manifest = back_up(Settings(), folder, step)
    _tell(manifest, f"{folder}: schema {manifest['revision']}, {manifest['images']} images", as_json)
    if manifest["damaged"]:
        typer.echo(f"heliotwin: {len(manifest['damaged'])} images are missing or damaged in the store itself", err=True)
        raise typer.Exit(1)


@app.command()
def restore(folder: Old, as_json: AsJson = False) -> None:
    """Put a back-up into an empty store, after all its hashes are verified."""
    from service.base.settings import Settings
    from service.store.backup import restore as put_back

    settings = Settings()
    settings.data_dir.mkdir(parents=True, exist_ok=True)
    with _showing("restore") as step:
        manifest = put_back(settings, folder, step)
    text = f"restored from {manifest['made_at']}: schema {manifest['revision']}, {manifest['images']} images"
    _tell(manifest, f"{text}; `heliotwin migrate` brings the schema up to date", as_json)


@app.command()
def check(as_json: AsJson = False) -> None:
    """Read every stored image and check its hash, and SQLite's file; exit code 1 if something is lost."""
    from service.base.settings import Settings
    from service.store.backup import images_of
    from service.store.check import inspect_store, is_sound
    from service.store.database import Database

    settings = Settings()
    database = Database(settings.database)
    try:
        with database.telling_damage(), _showing("check") as step:
            database.require_current()
            report = inspect_store(database, images_of(settings), step)
    finally:
        database.close()
    for sha256, found in report["bad"].items():
        typer.echo(f"image {sha256} is {found['reason']}; measurements {', '.join(found['measurements'])}", err=True)
    for fault in report["database"]:
        typer.echo(f"database: {fault}", err=True)
    counts = f"{report['images']} images, {len(report['bad'])} bad, {report['pruned']} pruned"
    _tell(report, f"{counts}, {report['unused']} unused, {report['leftovers']} leftovers", as_json)
    if not is_sound(report):
        raise typer.Exit(1)


def _tell(report: dict[str, Any], line: str, as_json: bool) -> None:
    typer.echo(json.dumps(report, indent=1) if as_json else line)
