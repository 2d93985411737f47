"""The verb that measures a camera: camera."""

from pathlib import Path
from typing import Annotated

import typer

from service.cli.output import AsJson, make_table, progress, require_file, show
from service.cli.verbs.photographs import Folder, Surfaces

app = typer.Typer()


@app.command()
def camera(
    folder: Folder,
    out: Annotated[Path, typer.Option("--out", help="JSON file to write the law to.", metavar="CAMERA.json")],
    surfaces: Surfaces = "measured",
    target: Annotated[
        list[str] | None, typer.Option(help="The camera looks at this target only; may be given again.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """A camera's curve from counts to light, measured from photographs of 8 bits: CAMERA.json, to be declared.

    Half of the days judge what the others tell; where sRGB is no worse, the file declares sRGB.
    """
    from service.cli.folder_camera import measure_camera
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
