"""Parts of a running service: settings, database, image store and model."""

import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol, cast

from numpy.typing import NDArray

from model.fleet import Engine, FleetFlux, Superposition, Tile
from model.imaging import Camera, ImageKind, MeasuredFlux
from model.observation import Observation, SurfacePrediction
from model.plant import Heliostat, TargetPlane
from model.plant_model import PlantModel
from model.progress import Progress
from model.setup import Setup
from model.study import FluxImage, Study, StudyOptions
from service.base import monitoring
from service.base.choices import Method
from service.base.progress import Progress as Named
from service.base.settings import Settings
from service.sources.decode import Pixels, TooManyPixelsError, decode_image
from service.store.database import Database
from service.store.image_files import ImageStore
from service.twin.caches import LargeResults
from service.twin.operations import Forecast
from service.twin.slots import ComputeSlots

# Longest time that a request waits for the model [s].
_PATIENCE_S = 10.0

LARGE_PIXELS = 12_500_000
"""Width x height of an image above which one image is decoded at a time."""


class Operations(Protocol):
    """Interface of `service.twin.operations`: the service's use of the model."""

    def measure(
        self,
        image: NDArray[Any],
        kind: ImageKind,
        plane: TargetPlane,
        *,
        corners: NDArray[Any] | None = None,
        camera: Camera | None = None,
    ) -> MeasuredFlux:
        """Measure flux, centre of mass and quality of a photograph."""

    def predict(
        self,
        heliostat: Heliostat,
        observations: Sequence[Observation],
        model: PlantModel,
        method: Method = "network",
        progress: Progress = ...,
    ) -> SurfacePrediction:
        """Predict a surface from observations."""

    def has_network(self, heliostat: Heliostat) -> bool:
        """Whether a network was trained for a heliostat's kind of mirror."""

    def render(
        self,
        heliostat: Heliostat,
        observations: Sequence[Observation],
        z: NDArray[Any] | None,
        model: PlantModel,
    ) -> NDArray[Any]:
        """Forecast the fluxes of observations with a surface."""

    def forecast(
        self,
        setup: Setup,
        model: PlantModel,
        resolution: tuple[int, int] = (256, 256),
        window: float | None = None,
    ) -> Forecast:
        """Forecast the flux of a heliostat on a plane."""

    def superpose(
        self,
        task: Superposition,
        parts: Iterable[Tile],
        engine: Engine | None = None,
        before: FleetFlux | None = None,
        done: Callable[[FleetFlux], None] = ...,
    ) -> FleetFlux:
        """Sum the flux of many heliostats on one receiver."""

    def study(
        self,
        flux_images: Sequence[FluxImage],
        model: PlantModel,
        options: StudyOptions | None = None,
        progress: Named = ...,
    ) -> Study:
        """Find effects that photographs require and the declared model lacks."""


def load_operations(networks: Path, effects_from: Sequence[Path] = ()) -> Operations:
    """Import the module `service.twin.operations`, with the networks of a folder and the
    effects of files and installed packages (`model.effects.own`).

    It is imported late because it loads the tracer's libraries.
    """
    import_module("model.effects.own").load_effects(effects_from)
    module = import_module("service.twin.operations")
    return cast(Operations, module.ModelOperations(networks))


@dataclass(frozen=True)
class Runtime:
    """The parts that every request uses."""

    settings: Settings
    database: Database
    images: ImageStore
    operations: Operations
    job_came: threading.Semaphore = field(default_factory=lambda: threading.Semaphore(0))
    """Released when this process queues a job.

    So workers need not wait for their next poll.
    """
    compute_slots: ComputeSlots = field(default_factory=lambda: ComputeSlots(2))
    """Slots for the use of the model; see `computing`."""
    decoding_slots: ComputeSlots = field(default_factory=lambda: ComputeSlots(3))
    """Slots for decoded photographs, which limit the memory of their pixels; see `decoded`."""
    large_image_slots: ComputeSlots = field(default_factory=lambda: ComputeSlots(1))
    """Single slot for photographs of more than `LARGE_PIXELS`."""
    large_plan_slots: ComputeSlots = field(default_factory=lambda: ComputeSlots(1))
    """Single slot for plans of aims with many heliostats and pixels; see `model.aiming.kernels`."""
    recent_images: LargeResults = field(default_factory=lambda: LargeResults(256_000_000))
    """Images of the mirrors of recent plans: another limit takes the same ones."""
    timeout_s: float | None = None
    """Longest wait for a slot [s]; None, for jobs, is without limit."""
    check: Callable[[], None] | None = None
    """Called while a job waits for a slot; raises if the job shall stop."""

    @classmethod
    def from_settings(cls, settings: Settings, operations: Operations | None = None) -> "Runtime":
        """Open what the settings name; ``operations`` replaces the model in tests."""
        settings.data_dir.mkdir(parents=True, exist_ok=True)
        return cls(
            settings=settings,
            database=Database(settings.database, settings.connections),
            images=ImageStore(settings.data_dir / "images"),
            operations=operations or load_operations(settings.networks, settings.effects_from),
            compute_slots=ComputeSlots(settings.parallel_computations),
            decoding_slots=ComputeSlots(settings.parallel_computations + 1),
        )

    @contextmanager
    def decoded(self, data: bytes) -> Iterator[Pixels]:
        """Decode an untrusted image file, and hold its pixels until the block ends.

        Raises what `decode_image` raises. Decoding takes no slot of the model, whatever the file
        costs to decode. Images of more than `LARGE_PIXELS` are decoded one at a time, because each
        takes up to a gigabyte.
        """
        most = self.settings.max_image_pixels
        with ExitStack() as slots:
            slots.enter_context(self.decoding_slots.slot(self.timeout_s))
            try:
                pixels = decode_image(data, max_pixels=min(LARGE_PIXELS, most))
            except TooManyPixelsError:
                if most <= LARGE_PIXELS:
                    raise
                slots.close()  # smaller photographs may pass meanwhile
                slots.enter_context(self.large_image_slots.slot(self.timeout_s))
                pixels = decode_image(data, max_pixels=most)
            yield pixels

    @contextmanager
    def computing(self, operation: str) -> Iterator[Operations]:
        """The model, in one of ``parallel_computations`` slots.

        ``operation`` is the label in the metrics.
        """
        with ExitStack() as slots:
            with monitoring.measure_duration(monitoring.WAITING_SECONDS, "wait"):
                slots.enter_context(self.compute_slots.slot(self.timeout_s, self.check))
            with monitoring.measure_duration(monitoring.MODEL_SECONDS.labels(operation), operation):
                yield self.operations
            # At a stop, the response asked the sender to send the request again. A result that
            # comes too late must not be stored in addition.
            self.compute_slots.refuse_closed(self.timeout_s)

    def for_requests(self) -> "Runtime":
        """The same runtime with a short wait, after which `computing` raises BusyError."""
        return replace(self, timeout_s=_PATIENCE_S)

    def close(self) -> None:
        """Close the database's connections."""
        self.database.close()
