"""Verbs on a whole field: flux on a receiver, what becomes of each watt, and aims under a limit."""

import json
from pathlib import Path
from typing import Annotated

import typer

from heliotwin.cli.output import (
    AsJson,
    AtTime,
    progress,
    quantity_table,
    require_file,
    require_folder,
    show,
)

app = typer.Typer()

PlantFile = Annotated[Path, typer.Argument(help="The plant's file.", metavar="PLANT.yaml")]
ReceiverName = Annotated[str, typer.Option(help="Receiver of the plant.", metavar="NAME")]
SunAt = Annotated[
    tuple[float, float] | None,
    typer.Option(help="The sun: azimuth from north, elevation [deg].", metavar="AZ EL"),
]
Dni = Annotated[
    float | None,
    typer.Option(
        min=1, max=2000, help="Direct normal irradiance [W/m2]; that of a clear sky if not given."
    ),
]
SurfacesOf = Annotated[
    Path | None,
    typer.Option(help="Folder that predict wrote; nominal mirrors if not given.", metavar="DIR"),
]
StatesOf = Annotated[
    Path | None,
    typer.Option(
        help="CSV of measured dimming and pointing errors; as declared if not given.",
        metavar="STATES.csv",
    ),
]
MapResolution = Annotated[
    tuple[int, int] | None,
    typer.Option(min=2, max=1024, help="Rows and columns of the map.", metavar="ROWS COLUMNS"),
]


@app.command()
def field(
    plant: PlantFile,
    receiver: ReceiverName,
    out: Annotated[Path, typer.Option("--out", help="Folder to write to.", metavar="OUT")],
    sun: SunAt = None,
    at: AtTime = None,
    dni: Dni = None,
    aims: Annotated[
        Path | None,
        typer.Option(
            help="CSV name,east_m,north_m,up_m,active; the receiver's middle if not given.",
            metavar="AIMS.csv",
        ),
    ] = None,
    surfaces: SurfacesOf = None,
    states: StatesOf = None,
    resolution: MapResolution = None,
    as_json: AsJson = False,
) -> None:
    """Trace the flux of a whole field on a receiver: OUT/flux.npz [W/m2] and OUT/field.json.

    The report has each heliostat's cosine, shading, blocking, reflectance, cleanliness,
    attenuation, intercept and absorptance.
    """
    import numpy as np

    from heliotwin.arguments import moment_of
    from heliotwin.field import FieldRequest, sun_of, trace_field
    from service.sources.plant_file import read_plant
    from service.sources.plant_tables import read_aims
    from service.twin.forecasts.mirror_states import AS_DECLARED, read_states

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
        AS_DECLARED if states is None else read_states(states, source.plant.heliostats),
    )
    with progress(None, "field") as step:
        found = trace_field(source, request, step)
    out.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(out / "flux.npz", flux=found.flux.astype(np.float32))
    text = json.dumps(found.report, indent=1)
    (out / "field.json").write_text(text + "\n", encoding="utf-8")
    show(found.report, as_json, quantity_table("Field", found.report["field"]))


@app.command()
def aim(
    plant: PlantFile,
    receiver: ReceiverName,
    limit: Annotated[
        str,
        typer.Option(
            help="Flux that the receiver can take [kW/m2], or a CSV of it over the unrolled map.",
            metavar="KW_M2 or FILE.csv",
        ),
    ],
    out: Annotated[Path, typer.Option("--out", help="The aims, a CSV file.", metavar="AIMS.csv")],
    report: Annotated[
        Path | None, typer.Option(help="What the aims are worth.", metavar="REPORT.json")
    ] = None,
    sun: SunAt = None,
    at: AtTime = None,
    dni: Dni = None,
    start: Annotated[
        Path | None, typer.Option(help="Aims that were good a moment before.", metavar="AIMS.csv")
    ] = None,
    flow_path: Annotated[
        Path | None,
        typer.Option(
            help="CSV of positions along the flow path, 0 to 1, and shares of the limit.",
            metavar="FILE.csv",
        ),
    ] = None,
    surfaces: SurfacesOf = None,
    states: StatesOf = None,
    resolution: MapResolution = None,
    as_json: AsJson = False,
) -> None:
    """Find the aim points of the most power under the flux that a receiver can take.

    In 95 % of cases of the pointing errors the whole map is within the limit. The report has an
    upper bound on the power of any aims, and what aims above and below the middle in turn reach.
    """
    from heliotwin.aim import find_aims, write_aims
    from heliotwin.arguments import moment_of
    from heliotwin.field import FieldRequest, sun_of
    from heliotwin.folder import write_json
    from service.sources.limits import read_limit
    from service.sources.plant_file import read_plant
    from service.sources.plant_tables import read_aims
    from service.twin.forecasts.mirror_states import AS_DECLARED, read_states

    for path in (out, report):
        if path is not None:
            require_file(path)
    flux_limit = read_limit(limit, flow_path)
    source = read_plant(plant)
    azimuth, elevation = sun_of(source, sun, moment_of(at))
    request = FieldRequest(
        receiver,
        azimuth,
        elevation,
        dni,
        surfaces=surfaces,
        resolution=resolution,
        states=AS_DECLARED if states is None else read_states(states, source.plant.heliostats),
    )
    begin = None if start is None else read_aims(start, source.plant.heliostats)
    with progress(None, "aim") as step:
        found = find_aims(source, request, flux_limit, begin, step)
    write_aims(out, found.plan)
    if report is not None:
        write_json(report, found.report)
    shown = {
        name: found.report[name]
        for name in ("power_w", "bound_w", "single_aim_power_w", "peak_p95_w_m2", "limit_w_m2")
    }
    show(found.report, as_json, quantity_table("Aims", shown))
