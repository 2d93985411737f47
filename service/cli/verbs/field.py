"""The verb on a whole field: flux on a receiver, and what becomes of each watt."""

import json
from pathlib import Path
from typing import Annotated

import typer

from service.cli.output import AsJson, AtTime, make_table, progress, require_folder, show

app = typer.Typer()


@app.command()
def field(
    plant: Annotated[Path, typer.Argument(help="The plant's file.", metavar="PLANT.yaml")],
    receiver: Annotated[str, typer.Option(help="Receiver of the plant.", metavar="NAME")],
    out: Annotated[Path, typer.Option("--out", help="Folder to write to.", metavar="OUT")],
    sun: Annotated[
        tuple[float, float] | None,
        typer.Option(help="The sun: azimuth from north, elevation [deg].", metavar="AZ EL"),
    ] = None,
    at: AtTime = None,
    dni: Annotated[
        float | None,
        typer.Option(
            min=1,
            max=2000,
            help="Direct normal irradiance [W/m2]; that of a clear sky if not given.",
        ),
    ] = None,
    aims: Annotated[
        Path | None,
        typer.Option(
            help="CSV name,east_m,north_m,up_m,active; the receiver's middle if not given.",
            metavar="AIMS.csv",
        ),
    ] = None,
    surfaces: Annotated[
        Path | None,
        typer.Option(
            help="Folder that predict wrote; nominal mirrors if not given.", metavar="DIR"
        ),
    ] = None,
    resolution: Annotated[
        tuple[int, int] | None,
        typer.Option(min=2, max=1024, help="Rows and columns of the map.", metavar="ROWS COLUMNS"),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Trace the flux of a whole field on a receiver: OUT/flux.npz [W/m2] and OUT/field.json.

    The report has each heliostat's cosine, shading, blocking, reflectance, attenuation, intercept
    and absorptance.
    """
    import numpy as np

    from service.cli.field import FieldRequest, sun_of, trace_field
    from service.cli.times import moment_of
    from service.sources.plant_file import read_plant
    from service.sources.plant_tables import read_aims

    require_folder(out)
    source = read_plant(plant)
    azimuth, elevation = sun_of(source, sun, moment_of(at))
    request = FieldRequest(
        receiver,
        azimuth,
        elevation,
        dni,
        None if aims is None else read_aims(aims, source.plant.heliostats),
        surfaces,
        resolution,
    )
    with progress(None, "field") as step:
        found = trace_field(source, request, step)
    out.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(out / "flux.npz", flux=found.flux.astype(np.float32))
    text = json.dumps(found.report, indent=1)
    (out / "field.json").write_text(text + "\n", encoding="utf-8")
    table = make_table("Field", "quantity", "value")
    for name, value in found.report["field"].items():
        table.add_row(name, f"{value:.6g}")
    show(found.report, as_json, table)
