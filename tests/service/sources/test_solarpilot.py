"""SolarPILOT's efficiency of a field that it laid out, and ours of the imported layout."""

from pathlib import Path

import pytest

from benchmarks import solarpilot
from heliotwin.field import FieldRequest, trace_field
from service.base.progress import no_progress

pytest.importorskip("PySAM", reason="NREL-PySAM is not installed; see the extra 'peers'")


@pytest.mark.full
@pytest.mark.filterwarnings("ignore:DatetimeIndex.dayofyear")  # in pvlib, by pandas 3
def test_efficiency_is_solarpilots(tmp_path: Path):
    theirs = solarpilot.laid_out(20.0)
    plant = solarpilot.our_plant(theirs.places, tmp_path)
    assert len(plant.plant.heliostats) == len(theirs.places) > 100
    azimuth, zenith, efficiency = min(theirs.efficiencies, key=lambda row: row[1])
    ours = solarpilot.our_efficiency(plant, azimuth + 180, 90 - zenith)
    assert ours == pytest.approx(efficiency, abs=0.01)
    # Aims at the axis meet the surface below its middle: 0.95 of the light lands.
    request = FieldRequest("main", (azimuth + 180) % 360, 90 - zenith, 1000.0)
    assert trace_field(plant, request, no_progress).report["field"]["intercept"] > 0.99
