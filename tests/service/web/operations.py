"""Stand-ins for the model."""

from dataclasses import replace
from typing import Any

from model.observation import Observation
from model.plant import Heliostat
from tests.service.conftest import FakeOperations


class Doubter(FakeOperations):
    """Explains no photograph under a sun in the east, and finds refined mirrors strange."""

    def predict(
        self, heliostat: Heliostat, observations: list[Observation], *rest: Any, **more: Any
    ) -> Any:
        made = super().predict(heliostat, observations, *rest, **more)
        misfits = tuple(0.31 if observation.sun[0] > 0.5 else 0.05 for observation in observations)
        return replace(
            made, misfits=misfits, mahalanobis_distance=2.4 if made.method == "refined" else 1.0
        )
