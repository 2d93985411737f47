"""Judging predicted surfaces: cases, figures, tables, plots."""

import json

import numpy as np
import pytest
import torch

from model.metrics import surface_error
from model.network.architecture import MAX_IMAGES, NetworkConfig
from model.network.predictor import default_predictor
from model.plant_model import JUELICH_MODEL
from training import crossvalidate, plots
from training.cases import ELSEWHERE, MAX_DISTANCE, SOURCE, Case, make_cases, within_reach
from training.config import TrainConfig
from training.evaluate import DISTANCES, REFINEMENT, SLOW, compared, draw, evaluate
from training.figures import Figures, outcomes_of
from training.methods import always, by_network, by_onnx, by_run, held_out_of
from training.render import CleanCamera, RealCamera, load_field
from training.surfaces import fold_of, load_surfaces, split
from training.train import Run

SMALL = NetworkConfig(channels=(8, 16, 16), features=32, hidden=32)
COUNT = 6


@pytest.fixture(scope="module")
def surfaces(stj) -> np.ndarray:
    return load_surfaces(stj)[0]


@pytest.fixture(scope="module")
def cases(stj, surfaces) -> list[Case]:
    return make_cases(surfaces[:3], ["a", "b", "c"], load_field(stj), COUNT, CleanCamera())


@pytest.fixture(scope="module")
def run(stj, tmp_path_factory) -> Run:
    config = TrainConfig(data=str(stj), steps=1, batch=2, network=SMALL, bfloat16=False)
    run = Run(config, tmp_path_factory.mktemp("run"), torch.device("cpu"))
    torch.nn.init.normal_(
        run.average.decoder[-1].weight, std=0.1
    )  # untrained it answers with the guess
    run.save()
    return run


def test_mirrors_stand_where_the_papers_stand(stj, cases):
    field = load_field(stj)
    near = field[within_reach(field)]
    assert np.linalg.norm(near - SOURCE.center, axis=1).max() <= MAX_DISTANCE
    assert np.abs(np.degrees(np.arctan2(near[:, 0], near[:, 1]))).max() <= 45
    assert 0.5 < len(near) / len(field) < 0.95
    np.testing.assert_allclose(ELSEWHERE.center - SOURCE.center, [-18, 0, 15])
    assert [case.surface for case in cases] == ["a", "b", "c"] * 2
    assert all(len(case.observations) == MAX_IMAGES for case in cases)


def test_the_first_of_many_cases_are_those_of_few(stj, surfaces, cases):
    again = make_cases(surfaces[:3], ["a", "b", "c"], load_field(stj), 2, CleanCamera())
    for first, second in zip(cases, again, strict=False):
        np.testing.assert_array_equal(first.observations[5].flux, second.observations[5].flux)
    imperfect = make_cases(surfaces[:3], ["a", "b", "c"], load_field(stj), 1, RealCamera())[0]
    np.testing.assert_array_equal(imperfect.observations[0].sun, cases[0].observations[0].sun)
    assert np.abs(imperfect.observations[0].flux - cases[0].observations[0].flux).sum() > 1


def test_new_suns_are_new(cases):
    for case in cases:
        used = np.array([o.sun for o in case.observations])
        new = np.array([o.sun for o in case.forecasts])
        assert (used @ new.T).max() < 1 - 1e-9


def test_the_truth_is_without_error_and_the_ideal_surface_is_not(cases):
    def truth(case: Case, images: int) -> tuple[np.ndarray, np.ndarray]:
        return case.truth, np.full((4, 8, 8), 1e-6)

    ideal = outcomes_of(always(np.zeros((4, 8, 8))), cases)
    figures = Figures.of(outcomes_of(truth, cases), ideal)
    assert figures.mae_mm["max"] == 0
    assert figures.flux_accuracy == figures.flux_accuracy_elsewhere == pytest.approx(1)
    assert figures.covered == 1
    assert figures.worse_than_ideal == 0
    errors = [surface_error(np.zeros((4, 8, 8)), case.truth) * 1e3 for case in cases]
    of_ideal = Figures.of(ideal, ideal)
    assert of_ideal.mae_mm["mean"] == pytest.approx(np.mean(errors), abs=1e-4)
    assert 0.4 < of_ideal.flux_accuracy < 0.9
    assert of_ideal.covered is None


def test_a_wrong_surface_is_worse_than_the_ideal_one(cases):
    ideal = outcomes_of(always(np.zeros((4, 8, 8))), cases)
    contrary = outcomes_of(lambda case, images: (-case.truth, None), cases)
    assert Figures.of(contrary, ideal).worse_than_ideal > 0.5
    assert Figures.of(contrary[:2], ideal).cases == 2


def test_a_runs_folder_is_evaluated_from_as_many_images_as_asked(run, cases):
    method = by_network(run.folder)
    z, z_std = method(cases[0], 3)
    assert z.shape == (4, 8, 8)
    assert z_std is None
    assert np.abs(z - method(cases[0], 4)[0]).max() > 0
    np.testing.assert_allclose(
        by_run(run, n_iterations=1)(cases[0], 3)[0],
        by_network(run.folder, n_iterations=1)(cases[0], 3)[0],
    )
    assert set(held_out_of(run.folder)) == set(run.names) - set(run.learnt)


def test_the_exported_network_is_asked_as_the_product_asks_it(cases):
    z, z_std = by_onnx(default_predictor(), n_iterations=1)(cases[0], 2)
    expected = default_predictor().predict(
        cases[0].heliostat, cases[0].observations[:2], JUELICH_MODEL, n_iterations=1
    )
    np.testing.assert_array_equal(z, expected.z)
    assert z_std is not None


@pytest.mark.full
def test_tables_and_plots_of_an_evaluation(run, cases, tmp_path):
    mean = run.mean.double().numpy()
    methods = compared(run.folder, run.folder, mean)
    methods.update(
        dict.fromkeys(SLOW, lambda case, images: (case.truth / images, np.full((4, 8, 8), 1e-4)))
    )
    evaluation = evaluate(methods, cases, few=3)
    assert evaluation.figures[REFINEMENT].cases == 3
    assert evaluation.figures["network"].cases == COUNT
    assert evaluation.over_inputs[REFINEMENT][0] == pytest.approx(0, abs=1e-9)
    assert np.diff(evaluation.over_inputs[REFINEMENT]).min() > 0
    assert all(len(errors) == len(DISTANCES) - 1 for errors in evaluation.over_distance.values())
    tables = evaluation.tables()
    widths = {line.count("|") for line in tables.splitlines() if line.startswith("| error")}
    assert widths == {len(methods) + 3}
    assert "0.92" in tables
    draw(evaluation, methods, cases, tmp_path)
    assert {p.name for p in tmp_path.glob("*.png")} == {
        "error-over-distance.png",
        "error-over-images.png",
        "surfaces.png",
    }


def test_a_mirror_is_drawn_as_it_is_seen_from_the_front():
    z = np.zeros((4, 8, 8))
    z[1, -1, -1] = 1  # the upper right facet's upper right corner
    drawn = plots.mirror(z, points=10)
    assert drawn.shape == (20, 20)
    assert np.unravel_index(drawn.argmax(), drawn.shape) == (0, 19)


def test_learning_curves_are_drawn_for_each_look(tmp_path):
    lines = [{"step": s, "train_mae_mm": 1 / s, "validation_mae_mm": [0.3, 0.2]} for s in (1, 2)]
    (tmp_path / "curve.jsonl").write_text("\n".join(map(json.dumps, lines)))
    axes = plots.learning_curves([tmp_path]).axes[0]
    assert len(axes.lines) == 3


def test_every_heliostat_but_those_apart_is_held_out_in_one_fold(stj):
    names = load_surfaces(stj)[1]
    used = sorted(set(range(47)) - set(split(names)["apart"]))
    folds = [fold_of(names, fold, 5) for fold in range(5)]
    assert sorted(np.concatenate([held_out for _, held_out in folds])) == used
    for train, held_out in folds:
        assert sorted([*train, *held_out]) == used
    for fold in (-1, 5):
        with pytest.raises(ValueError, match="fold must lie in"):
            fold_of(names, fold, 5)


def test_cross_validation_reports_the_spread_between_folds(surfaces, cases):
    ideal = outcomes_of(always(np.zeros((4, 8, 8))), cases)
    folds = [{"ideal surface": Figures.of(part, part)} for part in (ideal[:3], ideal[3:])]
    values = [fold["ideal surface"].mae_mm["mean"] for fold in folds]
    assert f"{np.mean(values):.3f} ± {np.std(values, ddof=1):.3f}" in crossvalidate.table(folds)
    methods = crossvalidate.methods_of(surfaces[:20], None)
    np.testing.assert_allclose(methods["mean surface"](cases[0], 8)[0], surfaces[:20].mean(axis=0))
    assert "network" not in methods


def test_a_network_that_has_seen_the_folds_surfaces_is_refused(stj, run):
    with pytest.raises(SystemExit, match="has learnt from"):
        crossvalidate.validate(stj, fold=1, folds=5, places=1, network=run.folder)
