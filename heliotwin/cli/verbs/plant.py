"""The commands ``heliotwin plant ...``: the file that describes any solar tower plant."""

import json
from pathlib import Path
from typing import Annotated, Literal

import typer
from rich.console import Console

from heliotwin.cli.output import AsJson, require_file, require_folder

app = typer.Typer(
    name="plant",
    help="A plant's file, plant.yaml: begin one, check it, draw it.",
    no_args_is_help=True,
)

ForeignFormat = Literal["artist", "solarpilot", "soltrace"]
PlantFile = Annotated[Path, typer.Argument(help="The plant's file.", metavar="PLANT.yaml")]


@app.command()
def check(file: PlantFile, as_json: AsJson = False) -> None:
    """Say what is understood of a plant's file, and what is assumed; or its mistakes, one a
    line.
    """
    from heliotwin.cli.plant_report import plant_lines, plant_report, types_table
    from service.sources.plant_file import read_plant

    described = read_plant(file)
    if as_json:
        typer.echo(json.dumps(plant_report(described), indent=1))
        return
    console = Console()
    for warning in described.warnings:
        console.print(warning, style="yellow", highlight=False, markup=False)
    first, *others = plant_lines(described)
    console.print(first, highlight=False, markup=False)
    console.print(types_table(described))
    for line in others:
        console.print(line, highlight=False, markup=False)


@app.command()
def new(
    file: Annotated[
        Path, typer.Argument(help="Where to write it, or a folder.", metavar="[PLANT.yaml]")
    ] = Path("plant.yaml"),
    as_json: AsJson = False,
) -> None:
    """Write a commented plant to begin with, and its layout.csv beside it.

    A path without .yaml is a folder for them.
    """
    from service.sources.plant_formats.imported import PLANT
    from service.sources.plant_template import LAYOUT, write_template

    if file.suffix.lower() not in (".yaml", ".yml"):
        file /= PLANT
    require_file(file)
    write_template(file)
    written = [str(file), str(file.with_name(LAYOUT))]
    if as_json:
        typer.echo(json.dumps({"written": written}))
        return
    typer.echo(f"{' and '.join(written)} are written; heliotwin plant check {file} reads them")


@app.command()
def show(
    file: PlantFile,
    out: Annotated[Path, typer.Option(help="The picture, a PNG file.")],
    as_json: AsJson = False,
) -> None:
    """Draw a plant: the field from above, and tower, receivers and targets from the side."""
    from service.drawing.pictures import plant_picture
    from service.sources.plant_file import read_plant

    require_file(out)
    described = read_plant(file)
    picture = plant_picture(
        described.plant, described.receivers, described.type_of, described.tower
    )
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_bytes(picture)
    typer.echo(json.dumps({"written": [str(out)]}) if as_json else f"{out} is written")


@app.command("import")
def import_(
    file: Annotated[
        Path,
        typer.Argument(
            help="SolTrace's .stinput, ARTIST's .h5, or CSV of SolarPILOT, OpenCSP or positions.",
            metavar="FILE",
        ),
    ],
    out: Annotated[Path, typer.Option(help="The folder for plant.yaml and its files.")],
    parameters_are_positions: Annotated[
        bool,
        typer.Option(
            "--parameters-are-positions",
            help="Read ARTIST's splines as fits of deflectometry; without it as their geometry.",
        ),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Make a plant of another program's file; notes say what the file leaves open."""
    from service.base.validation import counted
    from service.sources.plant_formats.formats import import_plant

    require_folder(out)
    imported, written = import_plant(file, out, parameters_are_positions)
    count = len(imported.heliostats)
    report = {
        "written": [str(path) for path in written],
        "heliostats": count,
        "notes": list(imported.notes),
    }
    if as_json:
        typer.echo(json.dumps(report, indent=1))
        return
    typer.echo("\n".join([*imported.notes, f"{counted(count, 'heliostat')} in {written[0]}"]))


@app.command()
def export(
    file: PlantFile,
    to: Annotated[ForeignFormat, typer.Option("--format", help="The other program.")],
    out: Annotated[Path, typer.Option(help="The file to write.")],
    sun: Annotated[
        tuple[float, float] | None,
        typer.Option(
            help="Sun azimuth from north over east and elevation [deg]; SolTrace needs it.",
            metavar="AZIMUTH ELEVATION",
        ),
    ] = None,
    aims: Annotated[
        Path | None,
        typer.Option(
            help="Aim points, name,east_m,north_m,up_m; without it the receivers' middles."
        ),
    ] = None,
    surfaces: Annotated[
        Path | None,
        typer.Option(help="Folder of measured surfaces for ARTIST; without it nominal mirrors."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Write a plant for another program; notes say what its format has no place for."""
    from service.sources.plant_file import read_plant
    from service.sources.plant_formats.formats import ExportOptions, write_foreign
    from service.sources.plant_tables import read_aims

    require_file(out)
    described = read_plant(file)
    points = None if aims is None else read_aims(aims, described.plant.heliostats)
    notes = write_foreign(described, to, out, ExportOptions(sun, points, surfaces))
    if as_json:
        typer.echo(json.dumps({"written": [str(out)], "notes": notes}, indent=1))
        return
    typer.echo("\n".join([f"{out} is written", *notes]))


@app.command()
def schema() -> None:
    """Print the JSON schema of plant.yaml, for editors and other programs."""
    from service.sources.plant_schema import json_schema

    typer.echo(json.dumps(json_schema(), indent=1))
