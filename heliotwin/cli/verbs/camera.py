"""The verb that measures a camera: camera."""

from pathlib import Path
from typing import Annotated

import typer

from heliotwin.cli.output import AsJson, make_table, progress, require_file, require_unbroken, show
from heliotwin.cli.verbs.photographs import Folder, Surfaces

app = typer.Typer()


@app.command()
def camera(
    folder: Folder,
    out: Annotated[
        Path, typer.Option("--out", help="JSON file to write the law to.", metavar="CAMERA.json")
    ],
    surfaces: Surfaces = "measured",
    target: Annotated[
        list[str] | None,
        typer.Option(help="The camera looks at this target only; may be given again."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Camera response curve, measured from 8-bit photographs: CAMERA.json, to be declared.

    Half of the days test the curve of the other half; if sRGB is no worse, the file declares sRGB.
    """
    from heliotwin.folder_camera import measure_camera
    from service.sources.folder import read_folder

    require_file(out)
    source = read_folder(folder)
    with progress(None, "camera") as step:
        report = measure_camera(source, out, surfaces, target or (), step)
    table = make_table("Accuracy of forecasts", "law", "mean")
    for law, accuracy in report["accuracy"].items():
        table.add_row(law, f"{accuracy:.4f}")
    show(report, as_json, table)
    if not as_json:
        typer.echo(report["conclusion"])
    require_unbroken(source)
