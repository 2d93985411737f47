"""From setups to flux images: what a model of the plant forecasts that a camera sees.

`align` turns the heliostats of setups so that their spots lie where they were measured, with all
effects on sun, mount and mirror. Its result traces flux and images with the model's optics and
cameras, as often as needed::

    aligned = align(setups, model)
    images = aligned.images(View(96, 96))

Gradients with respect to an effect's parameters hold the alignment fixed.
"""

import math
from collections.abc import Callable, Hashable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from datetime import datetime
from functools import partial
from typing import Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from model.effects import (
    Effect,
    acting,
    apply_image_effects,
    apply_mount_effects,
    apply_optics_effects,
    apply_sun_effects,
    effects_of_stage,
    in_light_order,
)
from model.images import FLUX_SIZE, FLUX_WINDOW, normalized
from model.mount import Mount
from model.plant import TargetPlane
from model.plant_model import PlantModel
from model.setup import Setup
from model.site import Site
from model.tracing import Optics, Scene, Window, trace
from model.tracing.alignment import align_to_spots
from model.tracing.sensitivity import HeightChanges, sensitivity

Array = NDArray[np.float64]

# Setups whose derivatives are traced at once: a second of work or less.
_N_DIFFERENTIATED = 8

Tracer = Callable[[Scene, Window, Optics], Tensor]
"""Irradiance (B, rows, columns) [W/m2] of a scene's B mirrors."""


_TRACED_PIXELS = 2**21
"""Pixels of the images that are traced at once: about 200 bytes each with padding."""


@dataclass(frozen=True)
class View:
    """The imaged part of the targets, and the accuracy of tracing.

    Attributes
    ----------
    rows, columns : int
    window : float or None [m]
        Side of a square about each spot; None for each whole target.
    samples, padding, cones
        As in `model.tracing.trace`.
    """

    rows: int = 96
    columns: int = 96
    window: float | None = None
    samples: int = 20
    padding: float = 0.25
    cones: Literal["mirror", "facet"] = "mirror"

    def window_on(self, plane: TargetPlane) -> Window:
        """The window on one target."""
        if self.window is None:
            return Window.of(plane, self.rows, self.columns)
        return Window(self.window, self.window, self.rows, self.columns, on_spot=True)

    def windows_on(self, group: "AlignedGroup") -> list[Window]:
        """The windows on a group's targets."""
        return [self.window_on(setup.plane) for setup in group.setups]

    def trace(self, scene: Scene, window: Window, optics: Optics) -> Tensor:
        """Trace irradiance (B, rows, columns) [W/m2] with the convolution tracer."""
        flux = trace(
            scene, window, optics, samples=self.samples, padding=self.padding, cones=self.cones
        )
        return flux.irradiance


def true_suns(model: PlantModel, suns: Array, taken_at: datetime | None = None) -> Array:
    """True unit vectors (B, 3) of recorded suns (B, 3), by the effects at a time."""
    return apply_sun_effects(acting(model.effects, taken_at, None), suns, model.site)


def crop_to_spots(images: Tensor, whole: Window, size: int, side: float) -> Tensor:
    """Energy (B, size, size) of images (B, rows, columns) in windows of ``side`` [m] about their
    centres of mass.

    As `model.imaging.window.flux_window` crops measured images, but differentiable.
    """
    axes = ((-1, whole.height), (-2, whole.width))
    shares = [_overlap(images.sum(dim=axis), extent, size, side) for axis, extent in axes]
    cropped: Tensor = shares[0] @ images @ shares[1].transpose(-1, -2)
    return cropped


def _overlap(line: Tensor, extent: float, size: int, side: float) -> Tensor:
    """Share (B, size, n) of n cells over ``extent`` [m] in the window about a ``line``'s centre."""
    cell = extent / line.shape[-1]
    low = torch.arange(line.shape[-1], dtype=line.dtype, device=line.device) * cell
    center = (line @ (low + cell / 2) / line.sum(dim=-1).clamp(min=1e-30))[:, None, None]
    edges = torch.linspace(-side / 2, side / 2, size + 1, dtype=line.dtype, device=line.device)
    first, last = center + edges[:-1, None], center + edges[1:, None]
    return (torch.minimum(last, low + cell) - torch.maximum(first, low)).clamp(min=0) / cell


@dataclass(frozen=True, eq=False)
class AlignedGroup:
    """Aligned setups that are traced at once, since their surfaces have one grid and one degree.

    Attributes
    ----------
    rows : list of int
        Their places among all setups.
    setups : list of B Setup
    scene : Scene
    angles : (B, 2) [rad]
        Of the mounts' axes.
    aims : (B, 3) [m]
        Points in ENU that the mirrors' centres aim at.
    is_truncated : (B,)
        Whether a spot extends over the edge of its target.
    displacements : (B, 2) [rad]
        From where the motors sent the light to where it lies, sidewards and upwards as seen from
        the mirror; NaN if either is not known.
    """

    rows: list[int]
    setups: list[Setup]
    scene: Scene
    angles: Array
    aims: Array
    is_truncated: NDArray[np.bool_]
    displacements: Array

    def parts(
        self, windows: Sequence[Window], effects: Sequence[Effect]
    ) -> Iterator[tuple[Window, tuple[Effect, ...], list[int]]]:
        """Windows and acting effects, each with the places of the setups that have them."""
        places: dict[tuple[Window, tuple[Effect, ...]], list[int]] = {}
        for place, (window, setup) in enumerate(zip(windows, self.setups, strict=True)):
            there = acting(effects, setup.taken_at, setup.heliostat.name)
            places.setdefault((window, there), []).append(place)
        for (window, there), alike in places.items():
            yield window, there, alike


PartTracer = Callable[[AlignedGroup, Window, Sequence[Effect], list[int]], Tensor]
"""Traces (b, ...) of the setups at some places of a group, with one window and equal effects."""


@dataclass(frozen=True, eq=False)
class Aligned:
    """Setups whose heliostats are aligned, and the model to trace them with.

    Attributes
    ----------
    groups : tuple of AlignedGroup
    model : PlantModel
        Its effects on geometry are in the groups already.
    """

    groups: tuple[AlignedGroup, ...]
    model: PlantModel

    @property
    def aims(self) -> Array:
        """Aim points (B, 3) [m] in ENU, in the setups' order."""
        return self._in_order([group.aims for group in self.groups])

    @property
    def angles(self) -> Array:
        """Axis angles (B, 2) [rad], in the setups' order."""
        return self._in_order([group.angles for group in self.groups])

    @property
    def displacements(self) -> Array:
        """`AlignedGroup.displacements` (B, 2) [rad], in the setups' order."""
        return self._in_order([group.displacements for group in self.groups])

    def _in_order(self, parts: Sequence[Array]) -> Array:
        """Values (B, ...) in the setups' order, of values (b, ...) of each group."""
        places = [row for group in self.groups for row in group.rows]
        return np.concatenate(parts)[np.argsort(places)]

    def deformed(self, changes: Tensor) -> "Aligned":
        """Change the control points of a single group by (B, F, 3, I, J) [m]; mounts stay."""
        (group,) = self.groups
        scene = group.scene.with_(control_points=group.scene.control_points + changes)
        return replace(self, groups=(replace(group, scene=scene),))

    def with_facet_light(self, shares: Tensor) -> "Aligned":
        """Multiply the light of each mirror's facets by shares (F,) [1]."""
        groups = []
        for group in self.groups:
            before = group.scene.facet_reflectivity
            of_facets = shares.to(group.scene.sun).expand(len(group.rows), -1)
            scene = group.scene.with_(
                facet_reflectivity=of_facets if before is None else before * of_facets
            )
            groups.append(replace(group, scene=scene))
        return replace(self, groups=tuple(groups))

    def flux(self, view: View | None = None, tracer: Tracer | None = None) -> Tensor:
        """Trace irradiance (B, rows, columns) [W/m2], by ``tracer`` instead of convolution."""
        view = view or View()
        trace_scene = tracer or view.trace

        def trace_part(
            group: AlignedGroup, window: Window, there: Sequence[Effect], places: list[int]
        ) -> Tensor:
            return trace_scene(
                group.scene.subset(places), window, apply_optics_effects(there, self.model.optics)
            )

        return self.trace_parts(
            view.windows_on, effects_of_stage(self.model.effects, "optics"), trace_part
        )

    def camera_images(self, flux: Tensor, view: View | None = None) -> Tensor:
        """Apply the effects of the cameras to ``flux`` (B, rows, columns) in the same view."""

        def image_part(
            group: AlignedGroup, window: Window, there: Sequence[Effect], places: list[int]
        ) -> Tensor:
            rows = [group.rows[place] for place in places]
            setups = [group.setups[place] for place in places]
            return apply_image_effects(there, flux[rows], window, setups, self.model.site)

        effects = effects_of_stage(self.model.effects, "image")
        return self.trace_parts((view or View()).windows_on, effects, image_part)

    def images(self, view: View | None = None, tracer: Tracer | None = None) -> Tensor:
        """Trace the flux and apply the effects of the cameras: images (B, rows, columns)."""
        return self.camera_images(self.flux(view, tracer), view)

    def flux_images(
        self, *, size: int = FLUX_SIZE, side: float = FLUX_WINDOW, samples: int = 20
    ) -> Tensor:
        """Trace the flux images (B, size, size) that would be measured, sum 100.

        As in a measurement: what the camera shows of the whole target is cropped to ``side`` [m]
        about its centre of mass. Without effects of the camera, on a target that holds the spot, it
        is the window about the flux's centre.
        """
        view = View(samples=samples)
        effects = effects_of_stage(self.model.effects, "optics", "image")

        def image_part(
            group: AlignedGroup, window: Window, there: Sequence[Effect], places: list[int]
        ) -> Tensor:
            flux = view.trace(
                group.scene.subset(places), window, apply_optics_effects(there, self.model.optics)
            )
            setups = [group.setups[place] for place in places]
            shown = _CameraView(window, there, setups, self.model.site)
            return _flux_image(flux, shown, size, side)

        return self.trace_parts(_flux_windows(self.model.effects, size, side), effects, image_part)

    def trace_parts(
        self,
        windows_on: Callable[[AlignedGroup], list[Window]],
        effects: Sequence[Effect],
        trace_part: PartTracer,
    ) -> Tensor:
        """Trace all parts of all groups: (B, ...) in the setups' order."""
        parts, places = [], []
        for group in self.groups:
            for window, there, alike in group.parts(windows_on(group), effects):
                most = max(1, _TRACED_PIXELS // (window.rows * window.columns))
                for start in range(0, len(alike), most):
                    some = alike[start : start + most]
                    parts.append(trace_part(group, window, there, some))
                    places += [group.rows[place] for place in some]
        return torch.cat(parts)[torch.as_tensor(places).argsort()]


def flux_changes(
    aligned: Aligned,
    directions: Tensor | HeightChanges,
    *,
    size: int = FLUX_SIZE,
    side: float = FLUX_WINDOW,
    samples: int = 20,
    between: Callable[[], None] = lambda: None,
    threads: int = 1,
) -> Tensor:
    """`Aligned.flux_images` (K + 1, B, size, size): unchanged, and after each of K height changes.

    ``directions`` are K changes of all mirrors, (K, F, I, J) [m] or as sums of shapes. Images are
    linear in them. The mounts keep the spots in place. A few setups are traced at once, by each of
    ``threads``; ``between`` is called before each time. There are no gradients.
    """
    view, model = View(samples=samples), aligned.model
    is_plain = isinstance(directions, Tensor)
    heights = HeightChanges.of(directions) if isinstance(directions, Tensor) else directions
    shapes = None if is_plain else heights.shapes

    def image_part(
        group: AlignedGroup, window: Window, there: Sequence[Effect], places: list[int]
    ) -> Tensor:
        count = min(_N_DIFFERENTIATED, math.ceil(len(places) / threads))
        parts = [places[start : start + count] for start in range(0, len(places), count)]
        work = partial(differentiate, group, window, there)
        if threads == 1 or len(parts) == 1:
            return torch.cat(list(map(work, parts)))
        with ThreadPoolExecutor(threads) as pool:
            return torch.cat(list(pool.map(work, parts)))

    @torch.no_grad()  # it is a thread's
    def differentiate(
        group: AlignedGroup, window: Window, there: Sequence[Effect], places: list[int]
    ) -> Tensor:
        between()
        scene, optics = group.scene.subset(places), apply_optics_effects(there, model.optics)
        flux = view.trace(scene, window, optics)
        by_shape = sensitivity(
            scene, window, optics, shapes=shapes, samples=samples, padding=view.padding
        )
        changes = heights.combine(by_shape)
        images = flux + torch.cat([torch.zeros_like(flux)[None], changes])
        setups = [group.setups[place] for place in places] * len(images)
        shown = _CameraView(window, there, setups, model.site)
        seen = _flux_image(images.flatten(0, 1), shown, size, side)
        return seen.view(-1, len(places), size, size).transpose(0, 1)

    effects = effects_of_stage(model.effects, "optics", "image")
    windows_on = _flux_windows(model.effects, size, side)
    return aligned.trace_parts(windows_on, effects, image_part).transpose(0, 1)


def _flux_windows(
    effects: Sequence[Effect], size: int, side: float
) -> Callable[[AlignedGroup], list[Window]]:
    """What is traced of a group's targets for flux images of ``size`` pixels over ``side`` [m].

    The window about the spot; the whole target if the spot is truncated, or a camera has effects.
    """
    view, pixel = View(size, size, window=side), side / size
    has_camera_effects = bool(effects_of_stage(effects, "image"))

    def window_on(plane: TargetPlane, is_truncated: bool) -> Window:
        if not (is_truncated or has_camera_effects):
            return view.window_on(plane)
        return Window.of(plane, math.ceil(plane.height / pixel), math.ceil(plane.width / pixel))

    return lambda group: [
        window_on(setup.plane, is_truncated)
        for setup, is_truncated in zip(group.setups, group.is_truncated, strict=True)
    ]


class _CameraView(NamedTuple):
    """A window on the targets of B setups, and the effects of the cameras that look at it."""

    window: Window
    effects: Sequence[Effect]
    setups: Sequence[Setup]
    site: Site


def _flux_image(flux: Tensor, shown: _CameraView, size: int, side: float) -> Tensor:
    """Flux images (B, size, size), sum 100, of ``flux`` (B, rows, columns), by the cameras."""
    window, effects, setups, site = shown
    if window.on_spot:
        return normalized(flux)
    images = apply_image_effects(effects, flux, window, setups, site).clamp(min=0)
    return normalized(crop_to_spots(images, window, size, side))


# --- alignment
# --------------------------------------------------------------------------------------------------


def align(
    setups: Sequence[Setup],
    model: PlantModel,
    *,
    dtype: torch.dtype = torch.float32,
    start: Aligned | None = None,
) -> Aligned:
    """Turn the heliostats of setups under a model's effects on sun, mount and mirror.

    Parameters
    ----------
    setups : sequence of Setup
    model : PlantModel
        Its optics, and its effects on optics and camera, are for tracing only.
    dtype : torch.dtype
        Of tracing; the alignment itself is in double precision.
    start : Aligned, optional
        The same setups under similar effects: saves rounds.

    Raises
    ------
    UnreachableError
        If no attitude reflects the sun to a spot.
    """
    geometry = in_light_order(effects_of_stage(model.effects, "geometry"))
    kinds: dict[tuple[Hashable, tuple[Effect, ...]], list[int]] = {}
    for row, setup in enumerate(setups):
        kinds.setdefault(
            (setup.kind, acting(geometry, setup.taken_at, setup.heliostat.name)), []
        ).append(row)
    aims = np.array([setup.goal for setup in setups]) if start is None else start.aims
    groups = (
        _align_group(rows, [setups[row] for row in rows], there, model.site, dtype, aims[rows])
        for (_, there), rows in kinds.items()
    )
    return Aligned(tuple(groups), model)


def _align_group(
    rows: list[int],
    setups: list[Setup],
    effects: Sequence[Effect],
    site: Site,
    dtype: torch.dtype,
    aims: Array,
) -> AlignedGroup:
    """Align setups of one kind under ``effects``; ``aims`` (B, 3) [m] are initial values."""
    heliostats = apply_mount_effects([setup.heliostat for setup in setups], effects)
    suns = apply_sun_effects(
        effects, np.array([setup.sun for setup in setups], dtype=np.float64), site
    )
    true = [
        replace(s, heliostat=h, sun=sun) for s, h, sun in zip(setups, heliostats, suns, strict=True)
    ]

    def alter(scene: Scene) -> Scene:
        for effect in effects:
            scene = effect.on_setups(scene, true, site)
        return scene

    by_motors = _angles_by_motors(setups, true)
    if setups[0].spot is None:
        angles, is_truncated = _given_angles(true, by_motors), np.zeros(len(rows), dtype=bool)
        scene = Scene.from_setups(true, angles, dtype=torch.float64)
    else:
        angles, aims, scene, is_truncated = align_to_spots(true, aims, alter)
    displacements = _displacements(true, by_motors, aims)
    return AlignedGroup(
        rows, setups, alter(scene.to(dtype)), angles, aims, is_truncated, displacements
    )


def _angles_by_motors(setups: Sequence[Setup], true: Sequence[Setup]) -> Array:
    """Axis angles (B, 2) [rad] by the motors, on the ``true`` setups' mounts; NaN if unknown."""
    recorded = [(np.nan, np.nan) if setup.angles is None else setup.angles for setup in setups]
    changes = [
        np.subtract(there.heliostat.mount.axis_zero, setup.heliostat.mount.axis_zero)
        for setup, there in zip(setups, true, strict=True)
    ]
    return np.array(recorded, dtype=np.float64) + changes


def _given_angles(true: Sequence[Setup], by_motors: Array) -> Array:
    """Axis angles (B, 2) [rad] of setups without a spot: by the motors, or by the aim point."""
    angles = by_motors.copy()
    aimed = [row for row, setup in enumerate(true) if setup.angles is None]
    if aimed:
        some = [true[row] for row in aimed]
        mount = Mount.stack([setup.heliostat.mount for setup in some])
        positions = [setup.heliostat.position for setup in some]
        goals = [setup.goal for setup in some]
        angles[aimed] = mount.align(positions, np.array([setup.sun for setup in some]), goals)
    return angles


def _displacements(true: Sequence[Setup], by_motors: Array, aims: Array) -> Array:
    """`AlignedGroup.displacements` (B, 2) [rad] of mirrors that aim at ``aims`` (B, 3) [m].

    A calibrated mount predicts where the light lands, not where the ray from the mirror's centre
    does: the mirror's tilt is part of its calibration.
    """
    displacements = np.full((len(true), 2), np.nan)
    known = [
        row for row, setup in enumerate(true) if setup.spot is not None and setup.angles is not None
    ]
    if known:
        some = [true[row] for row in known]
        mount = Mount.stack([setup.heliostat.mount for setup in some])
        attitude = mount.attitude(by_motors[known])
        centers = mount.mirror_center([setup.heliostat.position for setup in some], attitude)
        normal, sun = attitude[..., 2], np.array([setup.sun for setup in some])
        reflected = 2 * (normal * sun).sum(axis=-1, keepdims=True) * normal - sun
        ends = [
            setup.goal if setup.heliostat.mount.is_calibrated else aims[row]
            for row, setup in zip(known, some, strict=True)
        ]
        direction = np.array(ends) - centers
        direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
        sidewards = np.cross([0.0, 0.0, 1.0], direction)
        sidewards /= np.linalg.norm(sidewards, axis=-1, keepdims=True)
        axes = np.stack([sidewards, np.cross(direction, sidewards)], axis=-2)
        displacements[known] = -(axes @ reflected[..., None])[..., 0]
    return displacements
