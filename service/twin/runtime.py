"""What a running service holds: settings, database, image store, and the model behind one narrow door."""

import threading
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from datetime import datetime
from importlib import import_module
from typing import Any, Protocol, cast

from numpy.typing import NDArray

from model.effects import Effect
from model.fleet import Engine, FleetFlux, Tile
from model.imaging import Camera, ImageKind, MeasuredFlux
from model.observation import Observation, SurfacePrediction
from model.plant import Heliostat, Receiver, TargetPlane
from model.study import FluxImage, Study, StudyOptions
from model.tracing import Optics
from service.base import meters
from service.base.choices import Method
from service.base.progress import Progress
from service.base.settings import Settings
from service.store.database import Database
from service.store.images import ImageStore
from service.twin.compute import Forecast
from service.twin.gate import Gate

# Longest time that a request waits for others to be done with the model [s].
_PATIENCE_S = 10.0


class Operations(Protocol):
    """The model as the service uses it: the interface of the module `service.twin.compute`."""

    def measure(
        self,
        image: NDArray[Any],
        kind: ImageKind,
        plane: TargetPlane,
        *,
        corners: NDArray[Any] | None = None,
        camera: Camera | None = None,
    ) -> MeasuredFlux:
        """Flux, centre of mass and quality of a photograph."""

    def predict(
        self,
        heliostat: Heliostat,
        observations: Sequence[Observation],
        method: Method = "network",
        optics: Optics | None = None,
        effects: Sequence[Effect] = (),
        *,
        latitude_deg: float,
    ) -> SurfacePrediction:
        """A surface from observations."""

    def render(
        self,
        heliostat: Heliostat,
        observations: Sequence[Observation],
        z: NDArray[Any] | None,
        optics: Optics | None = None,
        effects: Sequence[Effect] = (),
        *,
        latitude_deg: float,
    ) -> NDArray[Any]:
        """What a surface would have thrown where fluxes were observed."""

    def forecast(
        self,
        heliostat: Heliostat,
        z: NDArray[Any] | None,
        sun: NDArray[Any],
        plane: TargetPlane,
        *,
        aim: NDArray[Any] | None = None,
        angles: NDArray[Any] | None = None,
        resolution: tuple[int, int] = (256, 256),
        window: float | None = None,
        optics: Optics | None = None,
        effects: Sequence[Effect] = (),
        latitude_deg: float,
        taken_at: datetime | None = None,
    ) -> Forecast:
        """The flux of a heliostat on a plane."""

    def superpose(
        self,
        receiver: Receiver,
        tiles: Iterable[Tile],
        *,
        resolution: tuple[int, int] = (256, 256),
        optics: Optics | None = None,
        effects: Sequence[Effect] = (),
        latitude_deg: float,
        engine: Engine | None = None,
    ) -> FleetFlux:
        """The light of many heliostats on one receiver."""

    def study(
        self,
        photographs: Sequence[FluxImage],
        optics: Optics,
        effects: Sequence[Effect] = (),
        options: StudyOptions | None = None,
        progress: Progress = ...,
        *,
        latitude_deg: float,
    ) -> Study:
        """Which effects photographs demand that a model with these optics and effects lacks."""


def load_operations() -> Operations:
    """The module `service.twin.compute`; imported late, because it brings the tracer's libraries with it."""
    return cast(Operations, import_module("service.twin.compute"))


@dataclass(frozen=True)
class Runtime:
    """The parts that every request works with."""

    settings: Settings
    database: Database
    images: ImageStore
    operations: Operations
    job_came: threading.Semaphore = field(default_factory=lambda: threading.Semaphore(0))
    """Released when a job is queued in this process, so that its workers need not wait until they look again."""
    gate: Gate = field(default_factory=lambda: Gate(2))
    """What all that use the model go through, `computing` for one use."""
    patience_s: float | None = None
    """How long to wait there: a job as long as it takes, a request no longer than a client would."""

    @classmethod
    def from_settings(cls, settings: Settings, operations: Operations | None = None) -> "Runtime":
        """Open what the settings name; `operations` stands in for the model in tests."""
        settings.data_dir.mkdir(parents=True, exist_ok=True)
        return cls(
            settings=settings,
            database=Database(settings.database, settings.connections),
            images=ImageStore(settings.data_dir / "images"),
            operations=operations or load_operations(),
            gate=Gate(settings.parallel_computations),
        )

    @contextmanager
    def computing(self, operation: str) -> Iterator[Operations]:
        """The model, while no more than ``parallel_computations`` callers use it; ``operation`` names the meter."""
        with ExitStack() as held:
            with meters.timed(meters.WAITING_SECONDS, "wait"):
                held.enter_context(self.gate.turn(self.patience_s))
            with meters.timed(meters.MODEL_SECONDS.labels(operation), operation):
                yield self.operations
            # The sender was told to send it again: what the request's thread finds too late is not kept beside that.
            self.gate.refuse_closed(self.patience_s)

    def for_requests(self) -> "Runtime":
        """The same for whoever does not wait long: `computing` raises BusyError then."""
        return replace(self, patience_s=_PATIENCE_S)

    def close(self) -> None:
        """Close the database's connections."""
        self.database.close()
