"""The commands ``heliotwin keys ...``."""

import json
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from service.base.choices import RoleName
from service.cli.output import AsJson
from service.cli.store import actor, reading, writing

Name = Annotated[
    str, typer.Argument(help="Who will use it, for example `calibration`.", metavar="NAME")
]

app = typer.Typer(name="keys", help="API keys: make, list, withdraw.", no_args_is_help=True)


@app.command()
def create(
    name: Name,
    role: Annotated[
        RoleName,
        typer.Option(help="read, ingest, operate or admin; each includes those before it."),
    ],
    as_json: AsJson = False,
) -> None:
    """Create a key and print it, only this once."""
    from service.store import keys

    with writing(makes=True) as session:
        key = keys.create(session, name, role, actor())
    typer.echo(json.dumps({"name": name, "role": role, "key": key}) if as_json else key)


@app.command("list")
def list_(as_json: AsJson = False) -> None:
    """List all keys, by name and prefix; the keys themselves are not stored."""
    from service.store import keys

    with reading() as session:
        rows = [] if session is None else keys.list_keys(session)
    if as_json:
        fields = ("name", "role", "prefix", "created_at", "withdrawn_at")
        typer.echo(
            json.dumps(
                [{field: getattr(row, field) for field in fields} for row in rows],
                default=str,
                indent=1,
            )
        )
        return
    table = Table("name", "role", "prefix", "made", "withdrawn")
    for row in rows:
        withdrawn = "" if row.withdrawn_at is None else f"{row.withdrawn_at:%Y-%m-%d %H:%M}"
        table.add_row(row.name, row.role, row.prefix, f"{row.created_at:%Y-%m-%d %H:%M}", withdrawn)
    Console().print(table)


@app.command()
def withdraw(name: Name, as_json: AsJson = False) -> None:
    """Withdraw a key: it is invalid from now on."""
    from service.store import keys

    with writing() as session:
        keys.withdraw(session, name, actor())
    typer.echo(json.dumps({"withdrawn": name}) if as_json else f"{name} is withdrawn")
