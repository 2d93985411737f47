"""The commands ``heliotwin models ...``."""

import json
from contextlib import closing
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from heliotwin.cli.output import AsJson
from heliotwin.cli.store import actor, reading, require_reason, writing

app = typer.Typer(
    name="models",
    help="Versions of the plant's model: list, adopt, withdraw.",
    no_args_is_help=True,
)


@app.command("list")
def list_(as_json: AsJson = False) -> None:
    """List all versions, oldest first; the current one is the newest that is not withdrawn."""
    from service.web.resources.models import all_models, declared_model

    with reading() as session:
        versions = (
            [declared_model(None, is_current=True)] if session is None else all_models(session)
        )
    if as_json:
        typer.echo(json.dumps([version.model_dump(mode="json") for version in versions], indent=1))
        return
    table = Table("version", "", "study", "adopted by", "withdrawn by")
    for version in versions:
        study = "" if version.study is None else str(version.study)
        people = (version.adopted_by or "", version.withdrawn_by or "")
        table.add_row(str(version.version), "current" if version.is_current else "", study, *people)
    Console().print(table)


@app.command()
def adopt(
    report: Annotated[
        Path, typer.Argument(help="Report of `heliotwin study`.", metavar="REPORT.json")
    ],
    force: Annotated[
        bool, typer.Option("--force", help="Also if another version than its own is current.")
    ] = False,
    reason: Annotated[
        str | None, typer.Option(help="Why; needed for open questions, or to force harm.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Add the effects of a folder's study to its model; this model becomes current."""
    from service import store
    from service.base.settings import Settings
    from service.sources.documents import read_json
    from service.twin import model_versions
    from service.twin.runtime import Runtime
    from service.twin.studies.field_change import require_no_contradiction
    from service.twin.studies.study import date_report, model_of_report, parse_report, row_of_report

    if reason is not None:
        require_reason(reason)
    name = report.name
    with writing() as session:
        document = read_json(report)
        parse_report(document, name)
        made = row_of_report(document, name, model_of_report(session, document, name), actor())
        date_report(session, made)
    is_change = bool(made.report["effects"] or made.report.get("discrepancy"))
    if is_change and not (force and reason):
        with closing(Runtime.from_settings(Settings())) as runtime:
            require_no_contradiction(runtime, made, {})
    with writing() as session:
        study = store.add_study(session, made)
        row = model_versions.adopt(session, study.id, actor(), force, reason)
        outdated = {
            one.heliostat: one.version for one in store.outdated_surfaces(session, row.version)
        }
    if as_json:
        typer.echo(
            json.dumps({"study": study.id, "version": row.number, "outdated_surfaces": outdated})
        )
        return
    typer.echo(f"version {row.number} is current")
    if outdated:
        typer.echo(
            f"active surfaces of {', '.join(outdated)} were made by another version; the page of"
            " studies, or a job `predictions`, makes them again"
        )


@app.command()
def withdraw(
    study: Annotated[
        int, typer.Argument(help="The study that it was adopted from.", metavar="STUDY")
    ],
    as_json: AsJson = False,
) -> None:
    """Withdraw what was adopted from a study; the version before is current again."""
    from service.twin import model_versions

    with writing() as session:
        model_versions.withdraw(session, study, actor())
        version = model_versions.current_number(session)
    typer.echo(json.dumps({"version": version}) if as_json else f"version {version} is current")
