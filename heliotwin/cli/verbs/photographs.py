"""The verbs on a measurement folder: flux, predict, forecast, study."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.table import Table

from heliotwin.cli.output import (
    AsJson,
    AtTime,
    make_table,
    progress,
    quantity_text,
    require_file,
    require_folder,
    require_unbroken,
    show,
)
from service.base.choices import Method

if TYPE_CHECKING:  # its libraries take seconds to load
    from service.sources.folder import MeasurementFolder

app = typer.Typer()

Folder = Annotated[
    Path, typer.Argument(help="Measurement folder in PAINT's layout.", metavar="DIR")
]
Out = Annotated[Path, typer.Option("--out", help="Folder to write to.", metavar="OUT")]
Surfaces = Annotated[str, typer.Option(help="measured, ideal, or a folder that predict wrote.")]

EffectsFile = Annotated[
    Path | None,
    typer.Option(
        "--effects",
        help="Effects to add to the declared ones: JSON, or a study's report.",
        metavar="FILE",
    ),
]

EffectsFrom = Annotated[
    list[Path] | None,
    typer.Option(
        "--effects-from",
        help="Python file that writes effects (heliotwin.effects); it is run. May be repeated.",
        metavar="OWN.py",
    ),
]

MountsFile = Annotated[
    Path | None,
    typer.Option(
        "--mounts",
        help=(
            "File that calibrate wrote: heliostats stand on its mounts, others as their properties"
            " say."
        ),
        metavar="MOUNTS.json",
    ),
]


def _count(folder: "MeasurementFolder") -> int:
    return sum(len(folder.measurements(name, False)) for name in folder.plant.heliostats)


@app.command()
def flux(folder: Folder, out: Out, as_json: AsJson = False) -> None:
    """Measure flux images from camera frames or crops: OUT/H/ID-flux.png, ID-flux-centered.npz,
    quality.json.
    """
    from heliotwin.folder import flux_folder
    from service.sources.folder import read_folder

    require_folder(out)
    source = read_folder(folder)
    with progress(_count(source), "flux") as step:
        report = flux_folder(source, out, step)
    table = make_table("Quality", "image", "accepted", "reason", "signal/background", "outside 4 m")
    for key, entry in report["images"].items():
        table.add_row(
            key,
            "yes" if entry["accepted"] else "no",
            entry["reason"] or "",
            f"{entry['signal_to_background']:.1f}",
            f"{entry['energy_outside_window']:.3f}",
        )
    show(report, as_json, table)
    require_unbroken(source)


@app.command()
def predict(
    folder: Folder,
    out: Out,
    method: Annotated[
        Method,
        typer.Option(
            help="network, or refined: the network, then MAP through the tracer. Mirrors that the"
            " network was not trained for are refined."
        ),
    ] = "network",
    images: Annotated[
        int, typer.Option(help="Most images used for a heliostat: 1 to 8, to 64 where refined.")
    ] = 8,
    mounts: MountsFile = None,
    as_json: AsJson = False,
) -> None:
    """Predict mirror surfaces from images: OUT/H/Deflectometry/H-nurbs-surface.npz and
    OUT/predictions.json.
    """
    from heliotwin.folder import predict_folder
    from service.sources.folder import read_folder

    require_folder(out)
    source = read_folder(folder)
    with progress(_count(source) + len(source.plant.heliostats), "predict") as step:
        report = predict_folder(source, out, method, images, step, mounts)
    table = make_table(
        "Surfaces", "heliostat", "images", "unexplained flux", "rms [mm]", "error to measured [mm]"
    )
    for name, entry in report["heliostats"].items():
        error = entry.get("against_measured", {}).get("mae_mm")
        table.add_row(
            name,
            str(len(entry["images"])),
            f"{entry['misfit']:.3f}",
            f"{entry['z_rms_mm']:.3f}",
            "" if error is None else f"{error:.3f}",
        )
    show(report, as_json, table)
    require_unbroken(source)


@app.command()
def forecast(
    folder: Folder,
    out: Out,
    surfaces: Surfaces = "measured",
    effects: EffectsFile = None,
    effects_from: EffectsFrom = None,
    mounts: MountsFile = None,
    window: Annotated[
        float | None,
        typer.Option(help="Side [m] of the accuracy's window; by the spot if not given."),
    ] = None,
    sun: Annotated[
        tuple[float, float] | None,
        typer.Option(
            help="A sun in place of the measurements': azimuth from north, elevation [deg].",
            metavar="AZ EL",
        ),
    ] = None,
    at: AtTime = None,
    target: Annotated[
        str | None,
        typer.Option(help="With --sun or --at: the folder's target or receiver to aim at."),
    ] = None,
    plane: Annotated[
        Path | None,
        typer.Option(
            help="With --sun or --at: JSON with center, normal, width, height [m].", metavar="FILE"
        ),
    ] = None,
    heliostat: Annotated[
        list[str] | None,
        typer.Option(help="With --sun or --at: of this heliostat only; may be given again."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Forecast the flux on the whole target for each measurement [W/m2]: OUT/H/ID-forecast.npz and
    OUT/forecast.json.

    With --sun or --at it uses no photographs and writes OUT/H/forecast.npz for each heliostat.
    """
    from heliotwin.folder_forecast import circularity, forecast_folder
    from model.effects.own import load_effects
    from service.sources.documents import read_effects
    from service.sources.folder import read_folder

    require_folder(out)
    load_effects(effects_from or ())
    added = () if effects is None else read_effects(effects)
    source = read_folder(folder)
    if any(given is not None for given in (sun, at, target, plane, heliostat)):
        from heliotwin.folder_sun import asked, forecast_for

        wanted = asked(source, sun, at, target, plane, heliostat or ())
        with progress(len(heliostat or source.plant.heliostats), "forecast") as step:
            report = forecast_for(source, out, wanted, surfaces, added, step, mounts)
        table = make_table("Forecasts", "heliostat", "peak", "power")
        for name, entry in report["heliostats"].items():
            table.add_row(
                name, *(quantity_text(key, entry[key]) for key in ("peak_w_m2", "power_w"))
            )
        show(report, as_json, table)
        require_unbroken(source)
        return
    with progress(_count(source), "forecast") as step:
        report = forecast_folder(source, out, surfaces, window, step, added, mounts)
    table = make_table(
        "Forecasts", "measurement", "accuracy", "window [m]", "outside", "peak [kW/m2]", "reason"
    )
    for key, entry in report["measurements"].items():
        compared = "accuracy" in entry
        table.add_row(
            key,
            f"{entry['accuracy']:.3f}" if compared else "",
            f"{entry['window']:.0f}" if compared else "",
            f"{entry['measured_outside']:.3f}" if compared else "",
            f"{entry['peak_w_m2'] / 1000:.2f}",
            entry.get("not_compared", ""),
        )
    if report["accuracy_mean"] is not None:
        table.add_section()
        table.add_row("mean", f"{report['accuracy_mean']:.3f}")
    show(report, as_json, table)
    if not as_json and (said := circularity(report)):
        typer.echo(said)
    require_unbroken(source)


@app.command()
def study(
    folder: Folder,
    out: Annotated[
        Path, typer.Option("--out", help="JSON file to write the report to.", metavar="REPORT.json")
    ],
    page: Annotated[
        Path | None,
        typer.Option("--html", help="Write the report as one web page, too.", metavar="FILE"),
    ] = None,
    surfaces: Surfaces = "measured",
    effects: EffectsFile = None,
    effects_from: EffectsFrom = None,
    mounts: MountsFile = None,
    as_json: AsJson = False,
) -> None:
    """Find physical effects that the declared model lacks, and their gain in
    accuracy: REPORT.json.
    """
    from heliotwin.folder import write_json
    from heliotwin.folder_study import study_folder
    from model.effects.own import load_effects
    from service.base.settings import Settings
    from service.sources.documents import read_effects
    from service.sources.folder import read_folder

    for path in filter(None, (out, page)):
        require_file(path)
    load_effects(effects_from or ())
    added = () if effects is None else read_effects(effects)
    source = read_folder(folder)
    scales = Settings().figure_scales
    with progress(None, "study") as step:
        done = study_folder(source, surfaces, effects=added, progress=step, mounts=mounts)
    report = done.to_json()
    write_json(out, report)
    if page is not None:
        from service.drawing.study_report import study_page

        page.parent.mkdir(parents=True, exist_ok=True)
        drawn = study_page(done.study, folder.resolve().name, scales, done.skipped)
        page.write_text(drawn, encoding="utf-8")
    show(report, as_json, _study_table(report))
    if not as_json:
        typer.echo(report["conclusion"])
    require_unbroken(source)


def _study_table(report: dict[str, Any]) -> Table:
    """All candidate effects, the best first, and the model's accuracy before and after."""
    table = make_table(
        f"Study: {report['verdict']}", "effect", "accuracy", "gain, 95 %", "score", ""
    )
    found = {effect["name"] for effect in report["effects"]}
    for candidate in report["candidates"]:
        low, high = candidate.get("gain", candidate["accuracy_gain"])["ci95"]
        accuracy, score = f"{candidate['accuracy_after']:.3f}", f"{candidate['score']:.1f}"
        mark = ("in part" if report["partly"] else "found") if candidate["name"] in found else ""
        table.add_row(candidate["name"], accuracy, f"{low:.3f} to {high:.3f}", score, mark)
    table.add_section()
    for name in ("before", "after"):
        table.add_row(f"all, {name}", f"{report[name]['accuracy_mean']:.3f}")
    if (unnamed := report["discrepancy"]) is not None:
        low, high = unnamed["accuracy_gain"]["ci95"]
        accuracy, place = f"{unnamed['accuracy_after']:.3f}", unnamed["lives_in"] or "no one place"
        table.add_row("without a name", accuracy, f"{low:.3f} to {high:.3f}", "", f"in {place}")
    return table
