"""A network for one heliostat type by one command, and its use for that type alone."""

import json
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from heliotwin.networks import main, read_scenes, train_network
from model.errors import InvalidInputError, WeightsError
from model.mirror_kind import MirrorKind
from model.network.architecture import NetworkConfig
from model.network.networks import Networks
from model.prior import draw_surfaces
from model.surface import control_points
from service.base.settings import Settings
from service.sources.folder import read_folder
from service.web.app import create_app
from tests.service.command import heliotwin, heliotwin_on
from tests.service.conftest import client_of
from tests.service.sources.plant_files import PLANT, write_plant
from tests.service.sources.plant_folder import LAYOUT, write_plant_folder
from training.config import TrainConfig
from training.type_network import TypeRun
from training.type_prior import measured_kind, type_prior, untilted

SMALL = TrainConfig(
    steps=2,
    batch=2,
    warmup=1,
    network=NetworkConfig(channels=(4, 8, 8), features=16, hidden=16, depth=1),
)
"""A training of seconds."""


FEW_FACETS = PLANT.replace("rows: 4, columns: 7", "rows: 1, columns: 2")
"""The type large with two facets: its images cost little."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A plant's folder with photographs of A1 of type large and B1 of type small, and a network for
    the former.
    """
    root = write_plant_folder(tmp_path_factory.mktemp("plant"), FEW_FACETS)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the exporter about itself
        train_network(root / "plant.yaml", "large", config=SMALL)
    return root


def test_card_says_which_mirrors_it_is_for(folder: Path):
    card = json.loads((folder / "networks" / "large.json").read_text(encoding="utf-8"))
    assert card["mirrors"]["first_axis"] == "vertical"
    assert len(card["mirrors"]["facet_centers_m"]) == 2
    assert card["trained_on"]["steps"] == 2
    assert card["onnx_parity_mm"] < 1e-4
    assert "declared errors" in card["trained_on"]["surfaces"]
    assert card["evaluation"]["network_mae_mm"] > 0
    assert MirrorKind.from_json(card["mirrors"]).to_json() == card["mirrors"]


def test_network_is_found_by_facets_sizes_and_mount(folder: Path):
    plant = read_folder(folder).plant
    networks, first = Networks(folder / "networks"), plant.heliostats["A1"]
    predictor = networks.of(first)
    assert predictor is not None
    assert predictor.name.startswith("large-")
    assert networks.of(first) is predictor  # loaded once
    other_mount = replace(first, mount=plant.heliostats["B1"].mount)
    fewer = replace(first, facets=first.facets[:1])
    larger = replace(
        first,
        facets=tuple(
            replace(f, canting_x=1.3 * f.canting_x, canting_y=1.3 * f.canting_y)
            for f in first.facets
        ),
    )
    for other in (plant.heliostats["B1"], other_mount, fewer, larger):
        assert networks.of(other) is None
    assert Networks().of(first) is None


def test_folder_predicts_with_the_network_of_the_type_and_refines_others(
    folder: Path, tmp_path: Path
):
    done = heliotwin("predict", folder, "--out", tmp_path, "--json")
    assert done.returncode == 0, done.stderr
    found = json.loads((tmp_path / "predictions.json").read_text(encoding="utf-8"))["heliostats"]
    assert found["A1"]["method"] == "network"
    assert found["A1"]["weights"].startswith("large-")
    assert "note" not in found["A1"]
    assert found["B1"]["method"] == "refined"
    assert "no network was trained for mirrors of 3 facets" in found["B1"]["note"]
    stored = np.load(tmp_path / "A1" / "Deflectometry" / "A1-nurbs-surface.npz")
    assert stored["z"].shape == stored["z_std"].shape == (2, 8, 8)
    assert np.isfinite(stored["z"]).all()


def test_service_predicts_with_the_networks_of_its_folder(folder: Path, tmp_path: Path):
    done = heliotwin_on(tmp_path, "import", folder)
    assert done.returncode == 0, done.stderr
    settings = Settings(data_dir=tmp_path, networks_dir=folder / "networks", job_workers=0)
    with client_of(create_app(settings)) as client:
        answers = {
            name: client.post(f"/v1/heliostats/{name}/surfaces", json={"method": "network"})
            for name in ("A1", "B1")
        }
        assert answers["A1"].status_code == 201, answers["A1"].text
        assert answers["A1"].json()["source"] == "network"
        assert answers["A1"].json()["model"].startswith("large-")
        assert answers["B1"].json()["source"] == "refined"


def test_training_continues_where_it_ended(tmp_path: Path):
    scenes = read_scenes(write_plant(tmp_path, FEW_FACETS, layout=LAYOUT), "large")
    device = torch.device("cpu")
    TypeRun(scenes, replace(SMALL, steps=1), tmp_path / "run", device).train(minutes=10)
    resumed = TypeRun(scenes, SMALL, tmp_path / "run", device)
    assert resumed.step == 1
    resumed.train(minutes=10)
    assert resumed.step == 2


def test_damaged_network_is_named_with_the_remedy(folder: Path, tmp_path: Path):
    for file in (folder / "networks").iterdir():
        if file.is_file():
            (tmp_path / file.name).write_bytes(file.read_bytes())
    heliostat = read_folder(folder).plant.heliostats["A1"]
    (tmp_path / "large.onnx").write_bytes(b"another")
    with pytest.raises(WeightsError, match=r"large\.onnx .*train the network again"):
        Networks(tmp_path).of(heliostat)
    (tmp_path / "large.json").unlink()
    with pytest.raises(WeightsError, match="no model card"):
        Networks(tmp_path).of(heliostat)


def test_wrong_types_and_plants_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = write_plant(tmp_path, layout=LAYOUT)
    with pytest.raises(InvalidInputError, match="'big' is none of large, small"):
        read_scenes(path, "big")
    with pytest.raises(SystemExit):
        main([str(path), "--type", "big"])
    assert "is none of large, small" in capsys.readouterr().err
    path.write_text(
        PLANT.replace(
            "normal: [0, 1, 0], up: [0, 0, 1], width_m: 12",
            "normal: [0, -1, 0], up: [0, 0, 1], width_m: 12",
        )
    )
    with pytest.raises(InvalidInputError, match="can shine on one of them"):
        read_scenes(path, "large").places  # noqa: B018


def test_prior_has_the_slopes_of_measured_mirrors(folder: Path):
    heliostat = read_folder(folder).plant.heliostats["A1"]
    half_sizes = heliostat.facet_frames.half_sizes
    declared = type_prior(heliostat, np.zeros((0, 2, 8, 8)))
    mirrors = untilted(draw_surfaces(declared, 8, np.random.default_rng(0)), half_sizes)
    kind = measured_kind(mirrors, half_sizes)
    assert 0.5e-3 < kind.slope < 2e-3  # declared: 1 mrad
    prior = type_prior(heliostat, mirrors)
    assert np.abs(prior.mean).max() > 0
    twice = measured_kind(2 * mirrors, half_sizes)
    assert twice.slope == pytest.approx(2 * kind.slope)


def test_measured_mirrors_of_the_folder_make_the_prior(tmp_path: Path):
    path = write_plant(tmp_path, FEW_FACETS, layout=LAYOUT)
    heliostat = read_scenes(path, "large").heliostats[0]
    z = 1e-4 * np.random.default_rng(0).normal(size=(2, 8, 8))
    surface = tmp_path / "A1" / "Deflectometry" / "A1-nurbs-surface.npz"
    surface.parent.mkdir(parents=True)
    np.savez(surface, control_points=control_points(heliostat, z), degrees=[3, 3])
    scenes = read_scenes(path, "large")
    assert scenes.measured.shape == (1, 2, 8, 8)
    assert scenes.prior.name == "measured"
