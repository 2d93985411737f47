"""The verbs on a folder's mounts: calibrate, spot."""

from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer

from heliotwin.cli.output import (
    AsJson,
    console,
    make_table,
    progress,
    require_file,
    require_unbroken,
    show,
)
from heliotwin.cli.verbs.photographs import Folder

app = typer.Typer()


@app.command()
def calibrate(
    folder: Folder,
    out: Annotated[
        Path, typer.Option("--out", help="JSON file to write the mounts to.", metavar="MOUNTS.json")
    ],
    until: Annotated[
        datetime | None,
        typer.Option(
            help=(
                "Only by those before this day: study --mounts says what changed since. Those of an"
                " unknown time are "
                "left out."
            ),
            formats=["%Y-%m-%d"],
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Calibrate mounts from motors, suns and spots, with uncertainties, steps, drift and outliers:
    MOUNTS.json.
    """
    from heliotwin.folder_pointing import calibrate_folder
    from model.pointing.report import clock_in_words
    from service.sources.folder import read_folder
    from service.twin.calibration import UndatedCount

    require_file(out)
    source = read_folder(folder)
    with progress(None, "calibrate") as step:
        report = calibrate_folder(
            source, out, step, None if until is None else until.replace(tzinfo=UTC)
        )
    if report["clock"] is not None:
        console.print(f"clock: {clock_in_words(report['clock'])}", style="yellow", highlight=False)
    said = UndatedCount(**report["undated"]).in_words()
    if said is not None:
        console.print(said, style="yellow", highlight=False)
    table = make_table(
        "Mounts", "heliostat", "measurements", "predicted error [mrad]", "90 %", "steps", "outliers"
    )
    for name, entry in report["heliostats"].items():
        left = entry["predicted_error_mrad"]
        figures = ("–", "–")
        if left["ci90"] is not None:
            low, high = left["ci90"]
            figures = (f"{left['median']:.2f}", f"{low:.2f} to {high:.2f}")
        table.add_row(
            name,
            str(entry["measurements"]),
            *figures,
            str(len(entry["steps"])),
            str(len(entry["outliers"])),
        )
    show(report, as_json, table)
    require_unbroken(source)


@app.command()
def spot(
    folder: Folder,
    mounts: Annotated[
        Path, typer.Option("--mounts", help="File that calibrate wrote.", metavar="MOUNTS.json")
    ],
    out: Annotated[
        Path, typer.Option("--out", help="JSON file to write the spots to.", metavar="SPOTS.json")
    ],
    as_json: AsJson = False,
) -> None:
    """Predict the spot of each measurement from its motors, with its uncertainty: SPOTS.json."""
    from heliotwin.folder_pointing import spot_folder
    from service.sources.folder import read_folder

    require_file(out)
    source = read_folder(folder)
    with progress(None, "spot") as step:
        report = spot_folder(source, mounts, out, step)
    table = make_table("Spots", "measurement", "east [m]", "north [m]", "up [m]", "± [m]", "target")
    for key, entry in report["spots"].items():
        table.add_row(
            key,
            *(f"{value:.2f}" for value in entry["spot"]),
            f"{entry['std_m']:.2f}",
            entry["target"],
        )
    show(report, as_json, table)
    require_unbroken(source)
