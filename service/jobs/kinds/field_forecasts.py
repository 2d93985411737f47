"""The job `forecasts`: the flux of many heliostats on one receiver."""

import pickle
import time
from dataclasses import astuple, dataclass, field
from hashlib import sha256
from typing import Any, Literal

import numpy as np
from pydantic import Field
from sqlalchemy.orm import Session

from model.fleet import LOSSES, FleetFlux, Losses
from model.plant import Receiver
from service import store
from service.base.fields import AnySun, Flag, Name, Position
from service.jobs.kind import (
    Context,
    Heliostats,
    Kind,
    Result,
    chosen_names,
    count_chosen,
    require_some,
)
from service.store import queue
from service.twin import model_versions
from service.twin.alarms.measured_states import read_mirror_states
from service.twin.forecasts.field_forecast import (
    Checkpoint,
    Fleet,
    HeliostatGroup,
    forecast_group,
    group_warnings,
)
from service.twin.forecasts.heliostat_forecast import receiver_as_json
from service.twin.forecasts.mirror_states import with_measured
from service.twin.forecasts.requests import ForecastBase, position_of
from service.twin.forecasts.watts import field_watts, heliostat_watts
from service.twin.runtime import Runtime


class FleetIn(ForecastBase):
    """Heliostats, their common receiver, and their aim points."""

    heliostats: Heliostats = Field(
        default=None,
        description=(
            "Names; all of the plant if not given, or those that its layout gives to the receiver."
            " The others cast shadows."
        ),
    )
    aim_points_m: dict[Name, Position] = Field(
        default_factory=dict,
        max_length=20_000,
        description="Where single heliostats aim instead [m], by name.",
    )
    neighbours: Flag = Field(
        default=True,
        description=(
            "Whether the mirrors of these heliostats shade and block each other, and the tower"
            " shades them."
        ),
    )

    def fleet(self, runtime: Runtime) -> Fleet:
        """The heliostats as the store has them now."""
        names = chosen_names(runtime, self.heliostats)
        with runtime.database.reading() as session:
            receiver = self.on(session)
            model = model_versions.get_model(session, self.model_version)
            tower = store.stored_tower(session)
            around = self._around(session)
        lit = [name for name in names if name not in around]
        return Fleet(
            names=lit,
            receiver=receiver,
            model=model,
            sunlight=self.dni_w_m2,
            aim=self.aim_point_m,
            aims=self.aim_points_m,
            tower=tower,
            states=read_mirror_states(runtime, lit) if self.measured_states else None,
            around=around,
        )

    def _around(self, session: Session) -> dict[str, Receiver]:
        """Other receivers that the layout gives to heliostats, by the heliostats' names.

        There are none if heliostats are named, or what they light is not of the layout.
        """
        given = {} if self.heliostats is not None else store.receivers_of_heliostats(session)
        if self.target not in given.values():
            return {}
        goals = {goal: store.get_target_or_receiver(session, goal) for goal in set(given.values())}
        return {name: goals[goal] for name, goal in given.items() if goal != self.target}


class FleetForecastIn(FleetIn):
    """Superpose the flux of many heliostats on one receiver: a plane, or an unrolled cylinder.

    The map is in W/m2. Camera effects of the model do not apply.
    """

    sun: AnySun
    surface: Literal["current", "ideal"] = Field(
        default="current",
        description=(
            "The heliostats' current surfaces, and the ideal mirror of those that have none; or"
            " ideal ones."
        ),
    )


# Seconds between checkpoints, the work that a restart may lose.
_CHECKPOINT_EVERY_S = 15.0
_CHECKPOINT = "light"

# Step with what becomes of each heliostat's light.
_DETAILS = "heliostats"


def forecast_field(context: Context, payload: FleetForecastIn) -> Result:
    """Sum the heliostats' flux maps [W/m2]. A restarted job continues from its checkpoint."""
    with context.runtime.database.reading() as session:
        sun = position_of(session, payload.sun)
    fleet = payload.fleet(context.runtime).under(sun, payload.surface == "ideal")
    saved = _Checkpoints(context, _fingerprint(fleet))
    total = forecast_group(
        context.runtime,
        fleet,
        payload.resolution,
        payload.neighbours,
        context.report,
        saved.load(),
        saved.save,
    )
    require_some(total.heliostats, total.skipped)
    ideal = sorted(fleet.without_surface - set(total.skipped))
    figures = {"warnings": group_warnings(len(ideal), total.heliostats)} | _figures(
        total.irradiance, fleet.receiver
    )
    figures |= {"model_version": fleet.model.number, "reflected_w": total.power}
    dni = fleet.model.optics.dni
    figures |= {"sun": sun.model_dump(), "dni_w_m2": dni, "field": field_watts(total, dni)}
    figures |= {"heliostats": total.heliostats, "skipped": total.skipped}
    figures |= {"ideal_surfaces": ideal, "sources": fleet.sources(total.skipped)}
    saved.drop()
    details: dict[str, object] = {"by_heliostat": heliostat_watts(total.losses, dni)}
    details["states"] = with_measured(fleet.traced_states)
    with context.runtime.database.writing() as session:
        context.replace(session, _DETAILS, details)
    return Result(figures, {"flux": total.irradiance.astype(np.float32)})


def _fingerprint(fleet: HeliostatGroup) -> str:
    """Fingerprint of heliostats, their states and the model, for which a checkpoint is valid."""
    return sha256(pickle.dumps((fleet.names, fleet.model.version, fleet.states))).hexdigest()


@dataclass(eq=False)
class _Checkpoints:
    """Checkpoints: the flux of a job's first tiles, stored from time to time as a step."""

    context: Context
    of: str
    saved_s: float = field(default_factory=time.monotonic)

    def load(self) -> Checkpoint | None:
        """The checkpoint of an earlier attempt, or None."""
        figures, arrays = (
            self.context.steps().get(_CHECKPOINT),
            self.context.kept_arrays(_CHECKPOINT),
        )
        if figures is None or arrays is None or figures["of"] != self.of or "names" not in figures:
            return None
        light = FleetFlux(
            arrays["irradiance"].astype(np.float64),
            figures["power"],
            figures["heliostats"],
            figures["skipped"],
            {
                name: Losses(*factors)
                for name, factors in zip(figures["names"], arrays["losses"].tolist(), strict=True)
            },
        )
        return Checkpoint(figures["tiles"], light)

    def save(self, checkpoint: Checkpoint) -> None:
        """Replace the last checkpoint, if it is old enough."""
        if time.monotonic() - self.saved_s < _CHECKPOINT_EVERY_S:
            return
        light = checkpoint.light
        figures = {"of": self.of, "tiles": checkpoint.tiles, "power": light.power}
        figures |= {"heliostats": light.heliostats, "skipped": light.skipped}
        figures |= {"names": list(light.losses)}
        losses = np.array([astuple(one) for one in light.losses.values()])
        arrays = {"irradiance": light.irradiance, "losses": losses.reshape(-1, 1 + len(LOSSES))}
        with self.context.runtime.database.writing() as session:
            self.context.replace(session, _CHECKPOINT, figures, arrays)
        self.saved_s = time.monotonic()

    def drop(self) -> None:
        """Delete the checkpoint, because the result replaces it."""
        with self.context.runtime.database.writing() as session:
            queue.delete_checkpoint(session, self.context.lease, _CHECKPOINT)


def _figures(flux: np.ndarray[Any, Any], receiver: Receiver) -> dict[str, object]:
    pixel_m2 = receiver.width * receiver.height / flux.size
    return {
        "peak_w_m2": float(flux.max()),
        "power_w": float(flux.sum() * pixel_m2),
        "plane": receiver_as_json(receiver),
    }


# Seconds per heliostat for a map of 256 x 256 pixels, and at least.
_MAP_S, _MIN_S = 0.02, 0.005


def expected_s(payload: FleetIn, runtime: Runtime) -> float:
    """Estimated duration for one sun position [s]."""
    rows, columns = payload.resolution
    return count_chosen(runtime, payload.heliostats) * max(_MIN_S, _MAP_S * rows * columns / 256**2)


KIND = Kind(
    "forecasts",
    FleetForecastIn,
    forecast_field,
    "Superpose the flux of many heliostats on one receiver.",
    details=_DETAILS,
    expected_s=expected_s,
)
