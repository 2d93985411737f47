"""Neighbours of photographed heliostats, from a described plant's layout."""

from pathlib import Path

import numpy as np

from heliotwin.folder_store import open_folder
from model.frames import sun_direction
from model.setup import Setup
from model.study import FluxImage
from model.surface import control_points
from service.sources.folder import read_folder
from service.twin.studies.known_neighbours import load_neighbours, with_neighbours
from tests.service.sources.plant_files import PLANT, write_plant

LAYOUT = """\
name,type,east_m,north_m,up_m
A1,large,0,150,0
A2,large,14,150,0
B1,small,0,139,0
C1,large,200,400,0
"""


def test_neighbours_are_those_of_the_layout_and_aim_at_the_receiver(tmp_path: Path):
    write_plant(tmp_path, PLANT, layout=LAYOUT)
    (tmp_path / "A1" / "Calibration").mkdir(parents=True)
    with open_folder(read_folder(tmp_path, whole_field=True), kinds=None) as opened:
        twin = opened.context("A1")
        found = load_neighbours(opened.session, twin)
        assert [one.heliostat.name for one in found] == ["A2", "B1"]
        assert all(np.hypot(one.aim[0], one.aim[1]) < 8.1 for one in found)
        plane = opened.folder.plant.targets["cal"]
        points = control_points(twin.heliostat)
        hidden = {}
        for azimuth in (90.0, 270.0):
            setup = Setup(twin.heliostat, points, sun_direction(azimuth, 8.0), plane)
            photograph = with_neighbours(FluxImage(setup, np.ones((8, 8))), found, twin.model)
            places = photograph.setup.neighbours
            assert places is not None
            hidden[azimuth] = bool((np.abs(places[:, 0, 0] - 14) < 2).any())
        assert hidden == {90.0: True, 270.0: False}
        assert with_neighbours(photograph, [], twin.model) is photograph
