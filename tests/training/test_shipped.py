"""The shipped weights, on mirrors that they have not learnt from."""

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from model.network.predictor import WEIGHTS, default_predictor, model_card
from training.cases import make_cases
from training.config import TrainConfig
from training.figures import Figures, outcomes_of
from training.methods import always, by_onnx
from training.render import CleanCamera, RealCamera, load_field
from training.surfaces import load_part

BEST = Path(__file__).parents[2] / "training" / "configs" / "best.json"
COUNT = 14
"""Two places of each test mirror."""


@pytest.mark.full
@pytest.mark.parametrize(("camera", "max_mm"), [(CleanCamera(), 0.125), (RealCamera(), 0.145)])
def test_shipped_weights_predict_test_mirrors_as_well_as_it_is_said(stj, camera, max_mm):
    surfaces, names = load_part(stj, "test")
    cases = make_cases(surfaces, names, load_field(stj), COUNT, camera)
    ideal = outcomes_of(always(np.zeros((4, 8, 8))), cases)
    found = Figures.of(outcomes_of(by_onnx(default_predictor()), cases), ideal)
    assert found.mae_mm["mean"] < max_mm
    assert found.flux_accuracy > 0.94
    assert found.covered is not None
    assert 0.85 < found.covered < 0.96


def test_the_card_is_of_the_shipped_weights_and_of_the_training_that_the_repository_has(stj):
    card = model_card()
    assert card["weights"] == default_predictor().name
    assert WEIGHTS.stem == card["name"]
    assert card["config"] == json.loads(json.dumps(asdict(TrainConfig.read(BEST))))
    assert card["trained_on"]["steps"] == TrainConfig.read(BEST).steps
    for part in ("test", "apart"):
        assert set(load_part(stj, part)[1]) <= set(card["trained_on"]["held_out"])
    assert set(card["trained_on"]["learnt"]).isdisjoint(card["trained_on"]["held_out"])


def test_exported_network_has_no_path_of_its_machine():
    assert b'File "' not in WEIGHTS.read_bytes()
