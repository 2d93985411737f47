"""What a running service holds: settings, database, image store, and the model behind one narrow door."""

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any, Protocol, cast

from numpy.typing import NDArray

from model.plant import Heliostat, TargetPlane
from service.database import Database
from service.images import ImageStore
from service.settings import Settings


class MeasuredFlux(Protocol):
    """What a photograph yields; see `model.imaging`."""

    @property
    def flux(self) -> NDArray[Any] | None:
        """(256, 256) over the whole target."""

    @property
    def centered(self) -> NDArray[Any] | None:
        """(64, 64) about the centre of mass, sum 100."""

    @property
    def center_of_mass(self) -> NDArray[Any] | None:
        """(2,) [m] right and up of the target's centre."""

    @property
    def quality(self) -> Any:
        """A dataclass with ``accepted``, ``reason``, ``detail`` and figures."""


class SurfacePrediction(Protocol):
    """A predicted surface: heights (4, 8, 8) and control points (4, 8, 8, 3) [m]."""

    @property
    def z(self) -> NDArray[Any]:
        """(4, 8, 8) [m]."""

    @property
    def z_std(self) -> NDArray[Any]:
        """(4, 8, 8) [m]."""

    @property
    def control_points(self) -> NDArray[Any]:
        """(4, 8, 8, 3) [m]."""

    @property
    def weights(self) -> str:
        """Name and hash of the network."""

    @property
    def misfit(self) -> float | None:
        """What the refinement left unexplained."""

    @property
    def used(self) -> Sequence[str]:
        """Identifiers of the observations that were used."""


class FluxForecast(Protocol):
    """A traced flux map and its figures."""

    @property
    def flux(self) -> NDArray[Any]:
        """(H, W) float32 [W/m2]."""

    @property
    def center_of_mass(self) -> NDArray[Any]:
        """(2,) [m] right and up of the plane's centre."""

    @property
    def peak(self) -> float:
        """[W/m2]."""

    @property
    def power(self) -> float:
        """[W]."""

    @property
    def model_version(self) -> str:
        """What computed it."""


class Operations(Protocol):
    """The model as the service uses it: the interface of the module `service.operations`."""

    @property
    def Observation(self) -> Callable[..., Any]:  # noqa: N802
        """Class of what `predict` takes."""

    def measure(
        self, image: NDArray[Any], kind: str, plane: TargetPlane, *, corners: NDArray[Any] | None = None
    ) -> MeasuredFlux:
        """Flux, centre of mass and quality of a photograph."""

    def predict(self, heliostat: Heliostat, observations: Sequence[Any], method: Any = "network") -> SurfacePrediction:
        """A surface from observations."""

    def forecast(
        self,
        heliostat: Heliostat,
        z: NDArray[Any] | None,
        sun: NDArray[Any],
        plane: TargetPlane,
        *,
        aim: NDArray[Any] | None,
        resolution: tuple[int, int],
        dni: float,
    ) -> FluxForecast:
        """The flux of a heliostat on a plane."""

    def weights_version(self) -> str:
        """Name and hash of the network's weights, loaded; raises where they cannot be."""


def load_operations() -> Operations:
    """The module `service.operations`; imported late, because it brings the tracer's libraries with it."""
    return cast(Operations, import_module("service.operations"))


@dataclass(frozen=True)
class Runtime:
    """The parts that every request works with."""

    settings: Settings
    database: Database
    images: ImageStore
    operations: Operations
    _gate: threading.Semaphore = field(default_factory=lambda: threading.Semaphore(2))

    @classmethod
    def from_settings(cls, settings: Settings, operations: Operations | None = None) -> "Runtime":
        """Open what the settings name; `operations` stands in for the model in tests."""
        settings.data_dir.mkdir(parents=True, exist_ok=True)
        return cls(
            settings=settings,
            database=Database(settings.database),
            images=ImageStore(settings.data_dir / "images"),
            operations=operations or load_operations(),
            _gate=threading.Semaphore(settings.parallel_computations),
        )

    @contextmanager
    def computing(self) -> Iterator[Operations]:
        """The model, while no more than ``parallel_computations`` callers use it."""
        with self._gate:
            yield self.operations

    def close(self) -> None:
        """Close the database's connections."""
        self.database.close()
