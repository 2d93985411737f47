"""Scenes: the input of both tracers, a batch of mirrors with poses, suns and target planes."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from model.errors import InvalidInputError
from model.images import FLUX_SIZE, FLUX_WINDOW
from model.mount import Mount, jitter_direction
from model.neighbours import stacked_rectangles
from model.plant import PERFECT, Outline, TargetPlane, inside_outline, outline_share
from model.setup import Setup
from model.sunshape import Buie, SunShape
from model.surface import DEGREE

Array = NDArray[np.float64]

COVERAGE_CELLS = 48
"""Cells along each side of a facet in which its outline is resolved."""


@dataclass(frozen=True, eq=False)
class Optics:
    """The sun, the mirror's reflectance and errors, and the air.

    Attributes
    ----------
    sun_shape : SunShape
    slope_error : float or Tensor (B,) [rad]
        Standard deviation of the mirror's normals per axis, below the resolution of the surface.
    tracking_jitter : float or Tensor (B,) [rad]
        Standard deviation of the mirror's rotation about `Mount.jitter_axis` during an exposure.
    pointing_error : float or Tensor (B,) [rad]
        Standard deviation of the reflected beam's direction per axis.
    dni : float [W/m2]
    reflectivity : float
    attenuation : tuple of float
        Lost share of the light between mirror and target: a polynomial in the slant range [km],
        constant term first.
    """

    sun_shape: SunShape = field(default_factory=Buie)
    slope_error: float | Tensor = 0.0
    tracking_jitter: float | Tensor = 0.0
    pointing_error: float | Tensor = 0.0
    dni: float = 1000.0
    reflectivity: float = 1.0
    attenuation: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if not 0 <= self.reflectivity <= 1:
            raise InvalidInputError(f"reflectivity must lie in [0, 1], got {self.reflectivity}")
        if not 0 <= self.dni < 1e5:
            raise InvalidInputError(f"dni [W/m2] must lie in [0, 100000), got {self.dni}")
        if not np.isfinite(self.attenuation).all():
            raise InvalidInputError(
                f"attenuation must be finite coefficients, got {self.attenuation}"
            )

    def irradiance(self, slant_range: Tensor) -> Tensor:
        """Irradiance [W/m2] of the light after mirror and air, for slant ranges [m]."""
        loss = torch.zeros_like(slant_range)
        for coefficient in reversed(self.attenuation):
            loss = loss * (slant_range / 1000) + coefficient
        return self.dni * self.reflectivity * (1 - loss.clamp(0, 1))


CLEAR_DAY = (0.006739, 0.1046, -0.0170, 0.002845)
"""Attenuation of a clear day, 23 km visibility (Vittitoe and Biggs 1978, as in DELSOL3,
SAND86-8018, eq. 2.2-3).
"""


Size = tuple[float, float]
"""Width and height [m]."""


@dataclass(frozen=True)
class Window:
    """The imaged rectangle of the target plane.

    Attributes
    ----------
    width, height : float [m]
    rows, columns : int
        Row 0 at the top, column 0 at the image's left edge.
    on_spot : bool
        Whether its centre is the spot's centre of mass instead of the plane's centre.
    """

    width: float = FLUX_WINDOW
    height: float = FLUX_WINDOW
    rows: int = FLUX_SIZE
    columns: int = FLUX_SIZE
    on_spot: bool = False

    def __post_init__(self) -> None:
        if not (0 < self.width < 1e4 and 0 < self.height < 1e4):
            raise InvalidInputError("window width and height must be positive metres")
        if not (1 <= self.rows <= 4096 and 1 <= self.columns <= 4096):
            raise InvalidInputError("window rows and columns must lie in [1, 4096]")

    @classmethod
    def of(cls, plane: TargetPlane, rows: int = 256, columns: int = 256) -> "Window":
        """The whole of a target plane."""
        return cls(width=plane.width, height=plane.height, rows=rows, columns=columns)

    @property
    def pixel(self) -> Size:
        """Size of a pixel."""
        return self.width / self.columns, self.height / self.rows


class PlaneScene(NamedTuple):
    """Control points (B, F, 3, I, J) [m], mirror centres (B, 3) [m] and suns (B, 3) in a plane.

    Points are relative to the centres, which the caller adds to them: slopes are differences of
    microns, and single precision would lose those in coordinates of a hundred metres.
    """

    control_points: Tensor
    center: Tensor
    sun: Tensor


@dataclass(frozen=True, eq=False)
class Scene:
    """A batch of mirrors, each with a sun and a target plane.

    Attributes
    ----------
    control_points : Tensor (B, F, 3, I, J) [m]
        In mirror coordinates; a batch of one is shared by all mirrors.
    attitude : Tensor (B, 3, 3)
        Mirror coordinates to ENU.
    center : Tensor (B, 3) [m]
        The mirror's centre in ENU.
    sun : Tensor (B, 3)
        Unit vectors towards the sun.
    plane_center : Tensor (B, 3) [m]
    plane_axes : Tensor (B, 3, 3)
        Right, up and normal of the target plane, as rows.
    degree : int
    facet_reflectivity : Tensor (B, F) or None
        Relative to `Optics.reflectivity`; None for equal facets.
    jitter_axis : Tensor (B, 3) or None
        The mount's axis in ENU about which tracking jitter rotates the mirror.
    blocked_below : Tensor (B,) or None [m]
        Mirror y below which a neighbour blocks the light; None for free mirrors.
    obstacles : Tensor (B, K, 3, 3) or None [m]
        Rectangles in ENU, centre and half sides, that shade and block the mirrors
        (`model.neighbours`).
    obstacle_share : Tensor (B,) or None
        Share of the light on obstacles that they take; None for all.
    neighbours : Tensor (B, K, 3, 3) or None [m]
        What an effect may make obstacles.
    shades : Tensor (B, K, 3, 3) or None [m]
        Rectangles that shade the mirrors only, such as the tower's outline.
    coverage : Tensor (B, F, n, n) or None
        Share of each facet's cells within its outline; None for facets that are rectangles.
    reflectance, slope_error, pointing_error : Tensor (B,) or None
        `MirrorOptics` of each mirror, in addition to `Optics`; reflectance times cleanliness.
    beam_turns : Tensor (B, 4, 3) or None [1/mrad]
        Changes of the beam's direction in ENU by the turns of `model.tracing.beam`.
    beam_moments : Tensor (B, 13) or None
        Moments of those angles, as in `BeamChange`; None for beams that do not change.
    """

    control_points: Tensor
    attitude: Tensor
    center: Tensor
    sun: Tensor
    plane_center: Tensor
    plane_axes: Tensor
    degree: int = DEGREE
    facet_reflectivity: Tensor | None = None
    jitter_axis: Tensor | None = None
    blocked_below: Tensor | None = None
    obstacles: Tensor | None = None
    obstacle_share: Tensor | None = None
    neighbours: Tensor | None = None
    shades: Tensor | None = None
    coverage: Tensor | None = None
    reflectance: Tensor | None = None
    slope_error: Tensor | None = None
    pointing_error: Tensor | None = None
    beam_turns: Tensor | None = None
    beam_moments: Tensor | None = None

    @classmethod
    def from_setups(
        cls,
        setups: Sequence[Setup],
        angles: ArrayLike,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str = "cpu",
    ) -> "Scene":
        """The scene of B setups with surfaces of one grid, at axis angles (B, 2) [rad]."""
        mount = Mount.stack([setup.heliostat.mount for setup in setups])
        attitudes = mount.attitude(angles)
        centers = mount.mirror_center([setup.heliostat.position for setup in setups], attitudes)
        planes = [setup.plane for setup in setups]
        different = {id(plane): plane for plane in planes}  # few planes, many mirrors
        axes = {key: plane.axes for key, plane in different.items()}

        def tensor(values: object) -> Tensor:
            return torch.as_tensor(np.asarray(values), dtype=dtype, device=device)

        return cls(
            control_points=tensor([setup.control_points for setup in setups])
            .movedim(-1, -3)
            .contiguous(),
            attitude=tensor(attitudes),
            center=tensor(centers),
            sun=tensor([setup.sun for setup in setups]),
            plane_center=tensor([plane.center for plane in planes]),
            plane_axes=tensor([axes[id(plane)] for plane in planes]),
            degree=setups[0].degree,
            jitter_axis=tensor(
                [
                    jitter_direction(setup.heliostat.mount, turned)
                    for setup, turned in zip(setups, np.asarray(angles), strict=True)
                ]
            ),
            **_mirror_tensors(setups, tensor),
        )

    def with_(self, **changes: Tensor) -> "Scene":
        """Replace some tensors."""
        return replace(self, **changes)  # type: ignore[arg-type]

    @property
    def batch(self) -> int:
        """Number of mirrors."""
        return self.sun.shape[0]

    def subset(self, rows: Sequence[int]) -> "Scene":
        """Select some mirrors, in the given order."""
        is_whole = list(rows) == list(range(self.batch))
        return self if is_whole else self.each(lambda tensor: tensor[list(rows)])

    def to(self, dtype: torch.dtype) -> "Scene":
        """Convert to another precision."""
        return self.each(lambda tensor: tensor.to(dtype))

    def each(self, change: Callable[[Tensor], Tensor]) -> "Scene":
        """Change every tensor."""
        tensors = {f.name: getattr(self, f.name) for f in fields(self)}
        return self.with_(**{k: change(v) for k, v in tensors.items() if isinstance(v, Tensor)})

    def in_plane(self) -> PlaneScene:
        """Transform the scene to the frame of each target plane.

        Splines are affine invariant: rotating the few control points rotates all samples.
        """
        turn = self.plane_axes @ self.attitude
        points = torch.einsum(
            "bij,bfjuv->bfiuv", turn, self.control_points.expand(self.batch, -1, -1, -1, -1)
        )
        center = torch.einsum("bij,bj->bi", self.plane_axes, self.center - self.plane_center)
        sun = torch.einsum("bij,bj->bi", self.plane_axes, self.sun)
        return PlaneScene(points, center, sun)

    def in_plane_frame(self, rectangles: Tensor | None) -> Tensor | None:
        """Obstacles or shades (B, K, 3, 3) [m] in the frame of each target plane."""
        if rectangles is None:
            return None
        origin = torch.zeros_like(rectangles)
        origin[..., 0, :] = self.plane_center[:, None]
        return (rectangles - origin) @ self.plane_axes.transpose(-1, -2)[:, None]


def by_facet(scene: Scene) -> Scene:
    """Make each facet a separate mirror (B * F mirrors); those of one mirror are adjacent."""
    facets = scene.control_points.shape[1]
    apart = scene.each(lambda tensor: tensor.repeat_interleave(facets, dim=0))
    points = scene.control_points.expand(scene.batch, -1, -1, -1, -1).flatten(0, 1)[:, None]
    own = {"control_points": points}
    if scene.facet_reflectivity is not None:
        own["facet_reflectivity"] = scene.facet_reflectivity.reshape(-1, 1)
    if scene.coverage is not None:
        own["coverage"] = scene.coverage.flatten(0, 1)[:, None]
    return apart.with_(**own)


def optics_of(scene: Scene, optics: Optics) -> Optics:
    """The optics with the mirrors' own slope and pointing errors, which add in variance."""
    if scene.slope_error is None or scene.pointing_error is None:
        return optics
    slope, pointing = (
        (torch.as_tensor(common).to(own) ** 2 + own**2).sqrt()
        for common, own in (
            (optics.slope_error, scene.slope_error),
            (optics.pointing_error, scene.pointing_error),
        )
    )
    return replace(optics, slope_error=slope, pointing_error=pointing)


def irradiance_of(scene: Scene, optics: Optics, slant_range: Tensor) -> Tensor:
    """Irradiance (B,) [W/m2] of the light after mirrors and air, for slant ranges (B,) [m]."""
    common = optics.irradiance(slant_range)
    return common if scene.reflectance is None else common * scene.reflectance


def _mirror_tensors(
    setups: Sequence[Setup], tensor: Callable[[object], Tensor]
) -> dict[str, Tensor]:
    """Neighbours, coverage and mirror optics of setups, where any is not that of a perfect
    rectangle that is alone.
    """
    heliostats = [setup.heliostat for setup in setups]
    tensors = {}
    if any(setup.neighbours is not None for setup in setups):
        none = np.zeros((0, 3, 3))
        tensors["neighbours"] = tensor(
            stacked_rectangles([none if s.neighbours is None else s.neighbours for s in setups])
        )
    if any(heliostat.optics != PERFECT for heliostat in heliostats):
        optics = [heliostat.optics for heliostat in heliostats]
        tensors["reflectance"] = tensor([one.reflectance * one.cleanliness for one in optics])
        for name in ("slope_error", "pointing_error"):
            tensors[name] = tensor([getattr(one, name) for one in optics])
    outlines = {tuple(facet.outline for facet in h.facets) for h in heliostats}
    if any(outline is not None for facets in outlines for outline in facets):
        cells = {facets: tensor([coverage(outline) for outline in facets]) for facets in outlines}
        tensors["coverage"] = torch.stack(
            [cells[tuple(facet.outline for facet in h.facets)] for h in heliostats]
        )
    return tensors


@lru_cache(maxsize=256)
def coverage(outline: Outline | None) -> Array:
    """Share (n, n) of the cells of a facet, along its x and y, that an outline encloses."""
    if outline is None:
        return np.ones((COVERAGE_CELLS, COVERAGE_CELLS))
    fine = 8 * COVERAGE_CELLS
    places = (np.arange(fine) + 0.5) / fine * 2 - 1
    inside = inside_outline(places[:, None], places[None, :], outline)
    cells = inside.reshape(COVERAGE_CELLS, 8, COVERAGE_CELLS, 8).mean(axis=(1, 3))
    return np.asarray(cells * (outline_share(outline) / cells.mean()))
