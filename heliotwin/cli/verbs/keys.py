"""The commands ``heliotwin keys ...``."""

import json
from datetime import datetime, timedelta
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from heliotwin.cli.output import AsJson
from heliotwin.cli.store import actor, reading, writing
from service.base.choices import RoleName

Name = Annotated[
    str, typer.Argument(help="Who will use it, for example `calibration`.", metavar="NAME")
]

_TIMES = ("created_at", "expires_at", "last_used_at", "withdrawn_at")

app = typer.Typer(name="keys", help="API keys: make, list, rotate, withdraw.", no_args_is_help=True)


@app.command()
def create(
    name: Name,
    role: Annotated[
        RoleName,
        typer.Option(help="read, ingest, operate or admin; each includes those before it."),
    ],
    days: Annotated[
        float | None,
        typer.Option(help="Days for which it is valid; without end by default.", min=0.01, max=1e4),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Create a key in the store of the settings, and print it, only this once."""
    from service.store import keys

    lasts = None if days is None else timedelta(days=days)
    with writing() as session:
        key = keys.create(session, name, role, actor(), lasts)
    _show(key, as_json, name=name, role=role)


@app.command()
def rotate(
    name: Name,
    overlap_days: Annotated[
        float, typer.Option(help="Days for which the former key stays valid.", min=0, max=365)
    ] = 7,
    as_json: AsJson = False,
) -> None:
    """Create the next key of a name and print it; both are valid for a while."""
    from service.store import keys

    with writing() as session:
        key = keys.rotate(session, name, actor(), timedelta(days=overlap_days))
    _show(key, as_json, name=name)


def _show(key: str, as_json: bool, **about: str) -> None:
    from service.base.settings import Settings

    store = Settings().store
    typer.echo(f"in the store of {store}", err=True)
    typer.echo(json.dumps({**about, "store": store, "key": key}) if as_json else key)


@app.command("list")
def list_(as_json: AsJson = False) -> None:
    """List all keys, by name and prefix; the keys themselves are not stored."""
    from service.store import keys

    with reading() as session:
        rows = [] if session is None else keys.list_keys(session)
    if as_json:
        fields = ("name", "role", "prefix", "state", *_TIMES)
        typer.echo(
            json.dumps(
                [{field: getattr(row, field) for field in fields} for row in rows],
                default=datetime.isoformat,
                indent=1,
            )
        )
        return
    table = Table("name", "role", "prefix", "state", "expires", "last used")  # of 80 columns
    for row in rows:
        times = (row.expires_at, row.last_used_at)
        shown = ["" if at is None else f"{at:%Y-%m-%d %H:%M}" for at in times]
        table.add_row(row.name, row.role, row.prefix, row.state, *shown)
    Console().print(table)


@app.command()
def withdraw(
    name: Name,
    former: Annotated[
        bool, typer.Option("--former", help="Only the key that `rotate` replaced.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Withdraw a key: it is invalid from now on."""
    from service.store import keys

    with writing() as session:
        keys.withdraw(session, name, actor(), former)
    typer.echo(json.dumps({"withdrawn": name}) if as_json else f"{name} is withdrawn")
