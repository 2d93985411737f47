"""SolarPILOT beside ours: ``python -m benchmarks.solarpilot``.

SolarPILOT, as NREL-PySAM has it (the extra ``peers``), lays out a field around a cylinder under
clear skies, and computes its optical efficiency over positions of the sun. `plant import` reads
that layout. Both have the same mirrors, receiver, air and sun. Mirrors are focused to the slant
range, SolarPILOT's by canted facets, and aim at mid height on the side toward each heliostat.

PySAM has no input for soiling, and its efficiency has none.
"""

import json
import multiprocessing
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy import stats

from benchmarks.record import Estimate, log_row, recording
from heliotwin.field import FieldRequest, trace_field
from service.base.progress import no_progress
from service.sources.plant_file import PlantDescription, read_plant
from service.sources.plant_formats.solarpilot import read_solarpilot

Array = np.ndarray

LATITUDE, LONGITUDE, ALTITUDE = 34.867, -116.783, 586.0
TOWER_M, RECEIVER_M, DIAMETER_M = 120.0, 15.0, 12.0
MIRROR_M, ROWS, COLUMNS = 12.2, 8, 2
REFLECTANCE, ABSORPTANCE = 0.95, 0.94
ERROR_MRAD = 1.53
ATTENUATION = (0.006789, 0.1046, -0.0170, 0.002845)
LOWEST_DEG, HIGH_DEG = 10.0, 25.0
"""Sun elevations from which efficiencies are compared, and from which few mirrors are shaded."""


class SolarPilotField(NamedTuple):
    """Places (N, 2) [m] of heliostats; efficiencies (S, 3): azimuth from south to west and zenith
    angle of the sun [deg], optical efficiency; seconds for both.
    """

    places: list[list[float]]
    efficiencies: list[list[float]]
    seconds: float


def write_weather(path: Path) -> None:
    """Hours of a year under a clear sky, as SAM reads them."""
    import pandas
    import pvlib

    hours = pandas.date_range("2025-01-01 00:30", periods=8760, freq="1h", tz="Etc/GMT+8")
    place = pvlib.location.Location(LATITUDE, LONGITUDE, "Etc/GMT+8", ALTITUDE)
    sky = place.get_clearsky(hours, model="simplified_solis")
    head = (
        "Source,Location ID,City,State,Country,Latitude,Longitude,Time Zone,Elevation\n"
        f"clear sky,1,Daggett,CA,USA,{LATITUDE},{LONGITUDE},-8,{ALTITUDE}\n"
        "Year,Month,Day,Hour,Minute,GHI,DNI,DHI,Temperature,Dew Point,Pressure,Wind Speed,"
        "Wind Direction,Relative Humidity,Albedo\n"
    )
    lines = [
        f"{hour:%Y,%m,%d,%H,%M},{row.ghi:.1f},{row.dni:.1f},{row.dhi:.1f},20,5,950,2,0,40,0.2\n"
        for hour, row in zip(hours, sky.itertuples(), strict=True)
    ]
    path.write_text(head + "".join(lines), encoding="ascii")


def lay_out(weather: Path, power_mw: float) -> SolarPilotField:
    """SolarPILOT's field of a thermal power [MW].

    Mirrors have 2 by 8 facets: with one that is not canted SolarPILOT ends with a memory error.
    """
    from PySAM import Solarpilot

    costs = {
        "land_spec_cost": 1e4,
        "csp_pt_sf_fixed_land_area": 45.0,
        "csp_pt_sf_land_overhead_factor": 1.0,
        "cost_sf_fixed": 0.0,
        "site_spec_cost": 16.0,
        "heliostat_spec_cost": 127.0,
        "tower_fixed_cost": 3e6,
        "tower_exp": 0.0113,
        "rec_ref_cost": 1.03e8,
        "rec_ref_area": 1571.0,
        "rec_cost_exp": 0.7,
        "contingency_rate": 7.0,
        "sales_tax_rate": 5.0,
        "sales_tax_frac": 80.0,
    }
    search = {
        "is_optimize": 0,
        "check_max_flux": 0,
        "flux_max": 1000.0,
        "opt_algorithm": 1,
        "opt_conv_tol": 0.001,
        "opt_flux_penalty": 0.25,
        "opt_init_step": 0.06,
        "opt_max_iter": 200,
    }
    maps = {
        "calc_fluxmaps": 1,
        "n_flux_days": 3,
        "delta_flux_hrs": 3,
        "n_flux_x": 12,
        "n_flux_y": 10,
    }
    model = Solarpilot.new()
    model.SolarPILOT.assign(
        {
            **costs,
            **search,
            **maps,
            **{f"c_atm_{power}": value for power, value in enumerate(ATTENUATION)},
            "solar_resource_file": str(weather),
            "q_design": power_mw,
            "dni_des": 950.0,
            "helio_width": MIRROR_M,
            "helio_height": MIRROR_M,
            "n_facet_x": COLUMNS,
            "n_facet_y": ROWS,
            "cant_type": 1,
            "focus_type": 1,
            "helio_optical_error": 1e-3 * ERROR_MRAD,
            "helio_active_fraction": 1.0,
            "dens_mirror": 1.0,
            "helio_reflectance": REFLECTANCE,
            "rec_absorptance": ABSORPTANCE,
            "rec_height": RECEIVER_M,
            "rec_aspect": RECEIVER_M / DIAMETER_M,
            "rec_hl_perm2": 30.0,
            "h_tower": TOWER_M,
            "land_max": 9.5,
            "land_min": 0.75,
        }
    )
    began = time.perf_counter()
    model.execute(0)
    seconds = time.perf_counter() - began
    outputs = model.Outputs
    places = [list(place) for place in outputs.heliostat_positions]
    return SolarPilotField(places, [list(row) for row in outputs.opteff_table], seconds)


def laid_out(power_mw: float) -> SolarPilotField:
    """`lay_out` in a separate process, which an error of SolarPILOT ends instead of ours."""
    with tempfile.TemporaryDirectory() as name:
        weather = Path(name) / "weather.csv"
        write_weather(weather)
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(1, mp_context=context) as pool:
            return pool.submit(lay_out, weather, power_mw).result()


def our_plant(places: list[list[float]], folder: Path) -> PlantDescription:
    """The imported layout with SolarPILOT's mirror, receiver and air in place of the notes'."""
    layout = folder / "solarpilot.csv"
    layout.write_text("".join(f"0,{east},{north},0\n" for east, north in places))
    imported = read_solarpilot(layout)
    parts: dict[str, Any] = json.loads(json.dumps(imported.parts))
    # The note's mirror is one facet of this size, focused to its slant range.
    parts["heliostat_types"]["T0"]["reflectance"] = REFLECTANCE
    parts["heliostat_types"]["T0"]["slope_error_mrad"] = ERROR_MRAD
    parts["receivers"]["main"] = {
        "kind": "cylinder",
        "center_m": [0, 0, TOWER_M],
        "radius_m": DIAMETER_M / 2,
        "height_m": RECEIVER_M,
        "absorptance": ABSORPTANCE,
    }
    parts["sun"] = {"shape": "pillbox", "half_angle_mrad": 4.65}
    parts["atmosphere"] = {"attenuation": list(ATTENUATION)}
    return read_plant(replace(imported, parts=parts).write(folder / "plant")[0])


def our_efficiency(plant: PlantDescription, azimuth_deg: float, elevation_deg: float) -> float:
    """Optical efficiency of the field; azimuth from north over east."""
    receiver = plant.receivers["main"]
    aims = {name: receiver.aim_of(one.position) for name, one in plant.plant.heliostats.items()}
    request = FieldRequest("main", azimuth_deg % 360, elevation_deg, 1000.0, dict(aims))
    return trace_field(plant, request, no_progress).report["field"]["optical_efficiency"]


def main(power_mw: float = 10.0) -> None:
    """Print efficiencies of both, and record their differences."""
    torch.set_num_threads(2)
    theirs = laid_out(power_mw)
    with tempfile.TemporaryDirectory() as name:
        plant = our_plant(theirs.places, Path(name))
    apart: dict[float, float] = {}
    began = time.perf_counter()
    for azimuth, zenith, efficiency in theirs.efficiencies:
        if zenith <= 90 - LOWEST_DEG:
            ours = our_efficiency(plant, azimuth + 180, 90 - zenith)
            apart[90 - zenith] = ours - efficiency
            print(f"{azimuth:8.1f} {zenith:6.1f} {ours:.4f} {efficiency:.4f}", flush=True)
    seconds = time.perf_counter() - began
    count = len(theirs.places)
    high = [value for elevation, value in apart.items() if elevation >= HIGH_DEG]
    low = [value for elevation, value in apart.items() if elevation < HIGH_DEG]
    differences(f"{count} heliostats, sun from {HIGH_DEG:.0f} degrees up", high, "<= 0.01")
    differences(f"{count} heliostats, sun from {LOWEST_DEG:.0f} degrees", low, None)
    log_row(
        "SolarPILOT beside ours",
        "time",
        {"SolarPILOT, layout included [s]": theirs.seconds, "ours [s]": seconds},
        n=len(apart),
        of="positions of the sun",
    )
    print(f"{theirs.seconds:.0f} s with the layout, ours {seconds:.0f} s")


def differences(row: str, apart: list[float], goal: str | None) -> None:
    """Print and record differences of efficiencies."""
    mean = float(np.mean(apart))
    reach = float(stats.sem(apart) * stats.t.ppf(0.975, len(apart) - 1))
    largest = float(np.abs(apart).max())
    print(f"{row}: {mean:+.4f} on average, {largest:.4f} at most")
    log_row(
        "SolarPILOT beside ours",
        row,
        {
            "efficiency, ours less SolarPILOT's": Estimate(mean, (mean - reach, mean + reach)),
            "largest difference": Estimate(largest, goal=goal),
        },
        n=len(apart),
        of="positions of the sun",
        compared_with="SolarPILOT (NREL-PySAM 7.1)",
    )


if __name__ == "__main__":
    with recording("solarpilot"):
        main()
