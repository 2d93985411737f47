"""The commands ``heliotwin backup``, ``restore`` and ``check``."""

import json
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from pydantic import TypeAdapter

from heliotwin.cli.output import AsJson, console
from heliotwin.cli.store import keep_private

app = typer.Typer()

New = Annotated[
    Path, typer.Argument(help="A new folder to write the back-up to.", metavar="FOLDER")
]
Old = Annotated[
    Path, typer.Argument(help="A folder that `heliotwin backup` wrote.", metavar="FOLDER")
]


@contextmanager
def _showing(what: str) -> Iterator[Any]:
    with console.status(what) as status:
        yield lambda name: status.update(f"{what} {name}")


@app.command()
def backup(folder: New, as_json: AsJson = False) -> None:
    """Write database and images to a new folder, while the service runs.

    The backup is consistent. The exit code is 1 if an image is bad.
    """
    from service.base.settings import Settings
    from service.store.backup import back_up
    from service.store.database import require_store

    settings = Settings()
    require_store(settings)
    keep_private()
    with _showing("backup") as step:
        manifest = back_up(settings, folder, step)
    _show(manifest, f"{folder}: schema {manifest.revision}, {manifest.images} images", as_json)
    if manifest.damaged:
        typer.echo(
            f"heliotwin: {len(manifest.damaged)} images are missing or damaged in the store itself",
            err=True,
        )
        raise typer.Exit(1)


@app.command()
def restore(folder: Old, as_json: AsJson = False) -> None:
    """Restore a backup into an empty store, after all its hashes are verified."""
    from service.base.settings import Settings
    from service.store.backup import restore as put_back

    keep_private()
    settings = Settings()
    settings.data_dir.mkdir(parents=True, exist_ok=True)
    with _showing("restore") as step:
        manifest = put_back(settings, folder, step)
    _show(
        manifest,
        f"restored from {manifest.made_at}: schema {manifest.revision}, {manifest.images} images",
        as_json,
    )


@app.command()
def check(as_json: AsJson = False) -> None:
    """Check the hash of every stored image, and SQLite's file; exit code 1 if anything is lost."""
    from service.base.settings import Settings
    from service.store.backup import images_of
    from service.store.check import inspect_store
    from service.store.database import Database, require_store

    settings = Settings()
    require_store(settings)
    with (
        closing(Database(settings.database)) as database,
        database.telling_damage(),
        _showing("check") as step,
    ):
        database.require_current()
        report = inspect_store(database, images_of(settings), step)
    for sha256, found in report.bad.items():
        typer.echo(
            f"image {sha256} is {found['reason']}; measurements {', '.join(found['measurements'])}",
            err=True,
        )
    for fault in report.database:
        typer.echo(f"database: {fault}", err=True)
    counts = f"{report.images} images, {len(report.bad)} bad, {report.pruned} pruned"
    _show(report, f"{counts}, {report.unused} unused, {report.leftovers} leftovers", as_json)
    if not report.is_sound:
        raise typer.Exit(1)


def _show(report: object, line: str, as_json: bool) -> None:
    typer.echo(
        json.dumps(TypeAdapter(Any).dump_python(report, mode="json"), indent=1) if as_json else line
    )
