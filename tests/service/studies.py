"""Studies that somebody made, and versions of the model that adopt them."""

from collections.abc import Sequence
from typing import Any

from service import store
from service.store.database import Database
from service.store.tables import PlantRow, StudyRow
from service.twin import model_versions
from tests.service.conftest import ORIGIN

GAMMA = {
    "name": "camera_response",
    "parameters": {"gamma": {"value": 0.8, "ci95": [0.78, 0.82], "unit": "1"}},
}


SLOPE = {
    "name": "slope_error",
    "parameters": {"sigma_mrad": {"value": 1.5, "ci95": [1.4, 1.6], "unit": "mrad"}},
}


def report_of(*effects: dict[str, Any], verdict: str = "effect") -> dict[str, Any]:
    """The report of a study that found these effects."""
    accuracy = {"accuracy_mean": 0.9, "accuracy_median": 0.9, "per_image": {"AA39/1": 0.9}}
    return {
        "verdict": verdict,
        "conclusion": "It is so.",
        "images": {"fit": 4, "held_out": 4},
        "before": accuracy,
        "after": accuracy,
        "noise_floor": 0.01,
        "unexplained_share": 0.1,
        "effects": list(effects),
        "candidates": [],
    }


def study_row(
    *effects: dict[str, Any],
    model: int = 1,
    verdict: str | None = None,
    heliostats: Sequence[str] = ("AA39",),
) -> StudyRow:
    """A study of ``heliostats`` that found these effects."""
    verdict = verdict or ("effect" if effects else "none")
    return StudyRow(
        created_by="tester",
        options={},
        heliostats=list(heliostats),
        model=model,
        model_version=f"{model}:",
        verdict=verdict,
        conclusion="It is so.",
        report=report_of(*effects, verdict=verdict),
        skipped={},
    )


def add(database: Database, *effects: dict[str, Any], **about: Any) -> int:
    """A study; of a store without a plant, which is set."""
    with database.writing() as session:
        if session.get(PlantRow, 1) is None:
            store.put_plant(session, "plant", ORIGIN)
        return store.add_study(session, study_row(*effects, **about)).id


def adopt(database: Database, study: int, force: bool = False) -> str:
    with database.changing() as session:
        return model_versions.adopt(session, study, "tester", force).version
