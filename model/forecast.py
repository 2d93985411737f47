"""From measurement setups to flux images: what a model of the plant expects a camera to see.

A `Setup` is the geometry of one measurement: one heliostat before one sun and one target. `align` turns the heliostats,
with every effect on sun, mount and mirror already in place; what it gives back traces itself under any optics and any
camera, as often as needed::

    aligned = align(setups, effects)
    images = aligned.images(optics, effects, View(96, 96))

or, in one step, `forecast_setups`. Gradients with respect to an effect's parameters hold the alignment fixed.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from model.effects import Effect, Since, Stage, acting, in_light_order
from model.images import FLUX_SIZE, FLUX_WINDOW, normalized
from model.mount import Mount
from model.plant import Heliostat, TargetPlane
from model.surface import DEGREE
from model.tracing import Optics, Scene, Window, trace
from model.tracing.alignment import align_scene
from model.tracing.sensitivity import sensitivity

Array = NDArray[np.float64]
Tracer = Callable[[Scene, Window, Optics], Tensor]
"""Irradiance (B, rows, columns) [W/m2] of a scene's B mirrors."""


@dataclass(frozen=True, eq=False)
class Setup:
    """The geometry of one measurement: one heliostat before one sun and one target.

    Attributes
    ----------
    heliostat : Heliostat
    control_points : (F, I, J, 3) [m]
        The mirror, in its own coordinates, as `model.surface.control_points` or a measurement gives it.
    sun : (3,)
        Unit vector towards the recorded sun in ENU.
    plane : TargetPlane
    spot : (3,) [m] or None
        Where the spot's centre of mass lies, in ENU: the heliostat is turned until it does.
    angles : (2,) [rad] or None
        Where the mount's axes stand, as its motors say: where no spot is given, there they are; beside a spot they tell
        how far it lies from where the motors sent it.
    aim : (3,) [m] or None
        Where the ray from the mirror's centre goes, where neither is given; the plane's centre without it.
    degree : int
        Of the surface's splines.
    identifier : str
    taken_at : datetime or None
        When, with time zone, where that is known: effects may come and go.
    """

    heliostat: Heliostat
    control_points: Array
    sun: Array
    plane: TargetPlane
    spot: Array | None = None
    angles: Array | None = None
    aim: Array | None = None
    degree: int = DEGREE
    identifier: str = ""
    taken_at: datetime | None = None

    @property
    def goal(self) -> Array:
        """The point (3,) [m] in ENU that the spot, or the mirror's centre, shall be sent to."""
        chosen = self.aim if self.spot is None else self.spot
        return np.asarray(self.plane.center if chosen is None else chosen, dtype=np.float64)

    @property
    def kind(self) -> tuple[object, ...]:
        """What setups must have in common to be aligned at once."""
        return (self.degree, *self.control_points.shape, self.spot is None)


@dataclass(frozen=True)
class View:
    """What is imaged of the targets, and how finely it is traced.

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

    def of(self, plane: TargetPlane) -> Window:
        """The window on one target."""
        if self.window is None:
            return Window.of(plane, self.rows, self.columns)
        return Window(self.window, self.window, self.rows, self.columns, on_spot=True)

    def of_all(self, group: "Group") -> list[Window]:
        """The windows on a group's targets."""
        return [self.of(plane) for plane in group.planes]

    def trace(self, scene: Scene, window: Window, optics: Optics) -> Tensor:
        """The convolution tracer, as finely as this view asks."""
        flux = trace(scene, window, optics, samples=self.samples, padding=self.padding, cones=self.cones)
        return flux.irradiance


def of_stage(effects: Iterable[Effect], *stages: Stage) -> list[Effect]:
    """Effects of some stages."""
    return [effect for effect in effects if effect.stage in stages]


def optics_under(effects: Iterable[Effect], optics: Optics) -> Optics:
    """The declared optics to what the light really meets under effects."""
    for effect in in_light_order(effects):
        optics = effect.on_optics(optics)
    return optics


def suns_under(effects: Iterable[Effect], suns: Array, latitude_deg: float) -> Array:
    """Unit vectors (B, 3) towards the sun, as recorded, to where it really stood; latitude [deg] of the plant."""
    for effect in effects:
        suns = effect.on_sun(suns, latitude_deg)
    return suns


def images_under(effects: Iterable[Effect], flux: Tensor, window: Window) -> Tensor:
    """Irradiance (B, rows, columns) over ``window`` to what a camera with effects shows of it."""
    for effect in in_light_order(effects):
        flux = effect.on_image(flux, window)
    return flux


def centered(images: Tensor, whole: Window, size: int, side: float) -> Tensor:
    """Energy (B, size, size) of images (B, rows, columns) in windows of ``side`` [m] about their centres of mass.

    As `model.imaging.window.flux_window` cuts measured images, differentiable.
    """
    axes = ((-1, whole.height), (-2, whole.width))
    shares = [_overlap(images.sum(dim=axis), extent, size, side) for axis, extent in axes]
    cut: Tensor = shares[0] @ images @ shares[1].transpose(-1, -2)
    return cut


def _overlap(line: Tensor, extent: float, size: int, side: float) -> Tensor:
    """Share (B, size, n) of n cells over ``extent`` [m] in those of the window about the centre of ``line`` (B, n)."""
    cell = extent / line.shape[-1]
    low = torch.arange(line.shape[-1], dtype=line.dtype, device=line.device) * cell
    center = (line @ (low + cell / 2) / line.sum(dim=-1).clamp(min=1e-30))[:, None, None]
    edges = torch.linspace(-side / 2, side / 2, size + 1, dtype=line.dtype, device=line.device)
    first, last = center + edges[:-1, None], center + edges[1:, None]
    return (torch.minimum(last, low + cell) - torch.maximum(first, low)).clamp(min=0) / cell


@dataclass(frozen=True, eq=False)
class Group:
    """Aligned setups whose mirrors are alike in their splines.

    Attributes
    ----------
    rows : list of int
        Their places among all setups.
    planes : list of TargetPlane
    taken : list of (str, datetime or None)
        Of which heliostats they are, and when they were photographed.
    scene : Scene
    angles : (B, 2) [rad]
    aims : (B, 3) [m]
        Where their mirrors' centres aim.
    cut : bool (B,)
        Whether their spots run over their targets' edges.
    displaced : (B, 2) [rad]
        Sidewards and upwards as seen from their mirrors, from where their motors sent the light to where it lies; NaN
        where either is not known.
    """

    rows: list[int]
    planes: list[TargetPlane]
    taken: list[tuple[str, datetime | None]]
    scene: Scene
    angles: Array
    aims: Array
    cut: NDArray[np.bool_]
    displaced: Array

    def parts(
        self, windows: Sequence[Window], effects: Sequence[Effect]
    ) -> Iterator[tuple[Window, tuple[Effect, ...], list[int]]]:
        """Windows on the targets and the effects that act there, with the places of those that have them alike."""
        places: dict[tuple[Window, tuple[Effect, ...]], list[int]] = {}
        for place, (window, (heliostat, moment)) in enumerate(zip(windows, self.taken, strict=True)):
            places.setdefault((window, acting(effects, moment, heliostat)), []).append(place)
        for (window, there), alike in places.items():
            yield window, there, alike


@dataclass(frozen=True, eq=False)
class Aligned:
    """Setups whose heliostats are aligned, under the geometry's effects, by their spots.

    Attributes
    ----------
    groups : tuple of Group
    """

    groups: tuple[Group, ...]

    @property
    def aims(self) -> Array:
        """Aim points (B, 3) [m] in ENU, in the setups' order."""
        return _in_order([group.aims for group in self.groups], self.groups)

    @property
    def angles(self) -> Array:
        """Axis angles (B, 2) [rad], in the setups' order."""
        return _in_order([group.angles for group in self.groups], self.groups)

    @property
    def displaced(self) -> Array:
        """How far (B, 2) [rad] spots lie from where motors sent them, in the setups' order, as `Group.displaced`."""
        return _in_order([group.displaced for group in self.groups], self.groups)

    def deformed(self, changes: Tensor) -> "Aligned":
        """The same setups, all alike in their splines, deformed: control points changed by (B, F, 3, I, J) [m].

        The mounts stay where they are.
        """
        (group,) = self.groups
        scene = group.scene.with_(control_points=group.scene.control_points + changes)
        return Aligned((replace(group, scene=scene),))

    def soiled(self, facets: Tensor) -> "Aligned":
        """The same setups, the light of each mirror's facets changed by shares (F,) [1]."""
        groups = []
        for group in self.groups:
            before = group.scene.facet_reflectivity
            shares = facets.to(group.scene.sun).expand(len(group.rows), -1)
            scene = group.scene.with_(facet_reflectivity=shares if before is None else before * shares)
            groups.append(replace(group, scene=scene))
        return Aligned(tuple(groups))

    def flux(
        self,
        optics: Optics | None = None,
        effects: Iterable[Effect] = (),
        view: View | None = None,
        tracer: Tracer | None = None,
    ) -> Tensor:
        """Irradiance (B, rows, columns) [W/m2] under optics, the same for all setups, to which the effects' are added.

        ``tracer`` takes the place of the convolution tracer.
        """
        view, declared = view or View(), optics or Optics()
        by_tracer = tracer or view.trace

        def traced(group: Group, window: Window, there: Sequence[Effect], rows: list[int]) -> Tensor:
            return by_tracer(group.scene.subset(rows), window, optics_under(there, declared))

        return self._each_part(view.of_all, of_stage(effects, "optics"), traced)

    def camera_images(self, flux: Tensor, effects: Iterable[Effect], view: View | None = None) -> Tensor:
        """What the effects of the camera make of ``flux`` (B, rows, columns), which was traced in the same view."""

        def imaged(group: Group, window: Window, there: Sequence[Effect], rows: list[int]) -> Tensor:
            return images_under(there, flux[[group.rows[row] for row in rows]], window)

        return self._each_part((view or View()).of_all, of_stage(effects, "image"), imaged)

    def images(
        self,
        optics: Optics | None = None,
        effects: Sequence[Effect] = (),
        view: View | None = None,
        tracer: Tracer | None = None,
    ) -> Tensor:
        """`flux`, then `camera_images`: images (B, rows, columns)."""
        return self.camera_images(self.flux(optics, effects, view, tracer), effects, view)

    def flux_images(
        self,
        optics: Optics | None = None,
        effects: Sequence[Effect] = (),
        *,
        size: int = FLUX_SIZE,
        side: float = FLUX_WINDOW,
        samples: int = 20,
    ) -> Tensor:
        """What would be measured of the same light: flux images (B, size, size) about their own centres, sum 100.

        As a measurement has it: what the camera shows of the whole target, and of that the window of ``side`` [m] about
        its centre of mass. Where no effect of a camera acts and the target shows all, that is the window about the
        light's.
        """
        view, declared = View(samples=samples), optics or Optics()

        def measured(group: Group, window: Window, there: Sequence[Effect], rows: list[int]) -> Tensor:
            flux = view.trace(group.scene.subset(rows), window, optics_under(there, declared))
            return _measured(flux, window, there, size, side)

        return self._each_part(_flux_windows(effects, size, side), of_stage(effects, "optics", "image"), measured)

    def flux_changes(
        self,
        directions: Tensor,
        optics: Optics | None = None,
        effects: Sequence[Effect] = (),
        *,
        size: int = FLUX_SIZE,
        side: float = FLUX_WINDOW,
        samples: int = 20,
    ) -> Tensor:
        """`flux_images` (K + 1, B, size, size) as they are, and to first order after each of K changes of the heights.

        ``directions`` are changes (K, F, I, J) [m] of all mirrors alike, for which the mounts keep the spots in place.
        """
        view, declared = View(samples=samples), optics or Optics()

        def measured(group: Group, window: Window, there: Sequence[Effect], rows: list[int]) -> Tensor:
            scene, effective = group.scene.subset(rows), optics_under(there, declared)
            flux = view.trace(scene, window, effective)
            heights = sensitivity(scene, window, effective, samples=samples, padding=view.padding)
            changes = (directions.flatten(1) @ heights.flatten(1)).view(-1, *flux.shape)
            images = flux + torch.cat([torch.zeros_like(flux)[None], changes])
            seen = _measured(images.flatten(0, 1), window, there, size, side)
            return seen.view(-1, len(rows), size, size).transpose(0, 1)

        windows, acting_there = _flux_windows(effects, size, side), of_stage(effects, "optics", "image")
        return self._each_part(windows, acting_there, measured).transpose(0, 1)

    def _each_part(
        self,
        windows: Callable[[Group], list[Window]],
        effects: Sequence[Effect],
        act: Callable[[Group, Window, Sequence[Effect], list[int]], Tensor],
    ) -> Tensor:
        """What ``act`` makes (b, ...) of the setups alike in window and effects, in the setups' order (B, ...)."""
        parts, places = [], []
        for group in self.groups:
            for window, there, rows in group.parts(windows(group), effects):
                parts.append(act(group, window, there, rows))
                places += [group.rows[row] for row in rows]
        return torch.cat(parts)[torch.as_tensor(places).argsort()]


def _flux_windows(effects: Sequence[Effect], size: int, side: float) -> Callable[[Group], list[Window]]:
    """What is traced of a group's targets for flux images of ``size`` pixels over ``side`` [m].

    The window about the spot; the whole target where that ends within the spot, or effects of a camera act.
    """
    view, pixel = View(size, size, window=side), side / size
    camera = bool(of_stage(effects, "image"))

    def windows(group: Group) -> list[Window]:
        return [
            Window.of(plane, math.ceil(plane.height / pixel), math.ceil(plane.width / pixel))
            if cut or camera
            else view.of(plane)
            for plane, cut in zip(group.planes, group.cut, strict=True)
        ]

    return windows


def _measured(flux: Tensor, window: Window, effects: Sequence[Effect], size: int, side: float) -> Tensor:
    """Flux images (B, size, size), sum 100, of what cameras with effects show of ``flux`` (B, rows, columns)."""
    if window.on_spot:
        return normalized(flux)
    return normalized(centered(images_under(effects, flux, window).clamp(min=0), window, size, side))


def _in_order(parts: Sequence[Array], groups: Sequence[Group]) -> Array:
    """Parts of each group (b, ...) in the setups' order (B, ...)."""
    places = [row for group in groups for row in group.rows]
    return np.concatenate(parts)[np.argsort(places)]


def align(
    setups: Sequence[Setup],
    effects: Iterable[Effect] = (),
    *,
    latitude_deg: float,
    dtype: torch.dtype = torch.float32,
    start: Aligned | None = None,
) -> Aligned:
    """Turn the heliostats of setups under the effects on sun, mount and mirror.

    Parameters
    ----------
    setups : sequence of Setup
    effects : iterable of Effect
        Those on optics and camera are of no account here.
    latitude_deg : float [deg]
        Of the plant.
    dtype : torch.dtype
        In which it will be traced; the alignment itself is in double precision.
    start : Aligned, optional
        The same setups under effects that differ little: saves rounds.

    Raises
    ------
    UnreachableError
        Where no attitude reflects the sun to the spot.
    """
    ordered = in_light_order(of_stage(effects, "geometry"))
    kinds: dict[tuple[tuple[object, ...], tuple[Effect, ...]], list[int]] = {}
    for row, setup in enumerate(setups):
        kinds.setdefault((setup.kind, acting(ordered, setup.taken_at, setup.heliostat.name)), []).append(row)
    aims = np.array([setup.goal for setup in setups]) if start is None else start.aims
    return Aligned(
        tuple(_align_group(setups, rows, there, latitude_deg, dtype, aims[rows]) for (_, there), rows in kinds.items())
    )


def _align_group(
    setups: Sequence[Setup],
    rows: list[int],
    effects: Sequence[Effect],
    latitude_deg: float,
    dtype: torch.dtype,
    aims: Array,
) -> Group:
    """Align the setups of one kind."""
    group = [setups[row] for row in rows]
    heliostats = altered([setup.heliostat for setup in group], effects)
    suns = suns_under(effects, np.array([setup.sun for setup in group], dtype=np.float64), latitude_deg)
    points, planes, degree = (
        [setup.control_points for setup in group],
        [setup.plane for setup in group],
        group[0].degree,
    )

    def alter(scene: Scene) -> Scene:
        for effect in effects:
            scene = effect.on_scene(scene, heliostats)
        return scene

    if group[0].spot is None:
        angles, cut = _given_angles(group, heliostats, suns), np.zeros(len(rows), dtype=bool)
        scene = Scene.build(heliostats, points, angles, suns, planes, degree=degree, dtype=torch.float64)
    else:
        goals = [setup.goal for setup in group]
        angles, aims, scene, cut = align_scene(
            heliostats, points, suns, planes, goals, degree=degree, start=aims, alter=alter
        )
    taken = [(setup.heliostat.name, setup.taken_at) for setup in group]
    displaced = _displaced(group, heliostats, suns, aims)
    return Group(rows, planes, taken, alter(scene.to(dtype)), angles, aims, cut, displaced)


def altered(heliostats: Sequence[Heliostat], effects: Sequence[Effect]) -> list[Heliostat]:
    """The heliostats on their mounts as the effects leave them; one that comes twice stays one.

    What effects say of a surveyed mount, a calibration has found in it by the photographs that it saw: only what came
    later acts on a calibrated one.
    """
    altered: dict[int, Heliostat] = {}
    for heliostat in heliostats:
        if id(heliostat) not in altered:
            mount = heliostat.mount
            for effect in effects:
                if not mount.is_calibrated or _came_later(effect, mount):
                    mount = effect.on_mount(mount, heliostat.name)
            altered[id(heliostat)] = replace(heliostat, mount=mount)
    return [altered[id(heliostat)] for heliostat in heliostats]


def _came_later(effect: Effect, mount: Mount) -> bool:
    """Whether an effect began after the newest photograph that a mount was calibrated by."""
    known = mount.calibrated_until
    return known is not None and isinstance(effect.scope, Since) and effect.scope.since > known


def _by_motors(setups: Sequence[Setup], heliostats: Sequence[Heliostat]) -> Array:
    """Where axes (B, 2) [rad] stand by the motors, on mounts as effects leave them; NaN where setups do not say."""
    said = [(np.nan, np.nan) if setup.angles is None else setup.angles for setup in setups]
    moved = [
        np.subtract(heliostat.mount.axis_zero, setup.heliostat.mount.axis_zero)
        for setup, heliostat in zip(setups, heliostats, strict=True)
    ]
    return np.array(said, dtype=np.float64) + moved


def _displaced(setups: Sequence[Setup], heliostats: Sequence[Heliostat], suns: Array, aims: Array) -> Array:
    """As `Group.displaced`, for mirrors whose light lies where it was measured when their centres aim at ``aims``.

    A calibrated mount sends not its centre's ray but the light to where it says: its mirror's tilt is in it.
    """
    displaced, angles = np.full((len(setups), 2), np.nan), _by_motors(setups, heliostats)
    told = [row for row, setup in enumerate(setups) if setup.spot is not None and setup.angles is not None]
    if told:
        mount = Mount.stack([heliostats[row].mount for row in told])
        attitude = mount.attitude(angles[told])
        centers = mount.mirror_center([heliostats[row].position for row in told], attitude)
        normal, sun = attitude[..., 2], suns[told]
        light = 2 * (normal * sun).sum(axis=-1, keepdims=True) * normal - sun
        way = np.array([setups[row].goal if heliostats[row].mount.is_calibrated else aims[row] for row in told])
        way -= centers
        way /= np.linalg.norm(way, axis=-1, keepdims=True)
        sidewards = np.cross([0.0, 0.0, 1.0], way)
        sidewards /= np.linalg.norm(sidewards, axis=-1, keepdims=True)
        seen = np.stack([sidewards, np.cross(way, sidewards)], axis=-2)
        displaced[told] = -(seen @ light[..., None])[..., 0]
    return displaced


def _given_angles(setups: Sequence[Setup], heliostats: Sequence[Heliostat], suns: Array) -> Array:
    """Axis angles (B, 2) [rad] of setups without a spot: as given, or by the aim of the mirror's centre."""
    angles = _by_motors(setups, heliostats)
    aimed = [row for row, setup in enumerate(setups) if setup.angles is None]
    if aimed:
        mount = Mount.stack([heliostats[row].mount for row in aimed])
        positions, goals = ([heliostats[row].position for row in aimed], [setups[row].goal for row in aimed])
        angles[aimed] = mount.align(positions, suns[aimed], goals)
    return angles


def forecast_setups(
    setups: Sequence[Setup],
    optics: Optics | None = None,
    effects: Sequence[Effect] = (),
    view: View | None = None,
    *,
    latitude_deg: float,
    dtype: torch.dtype = torch.float32,
) -> Tensor:
    """Images (B, rows, columns) that the model, with its effects, expects of setups, in W/m2 but for the camera.

    Raises
    ------
    UnreachableError
        Where no attitude reflects the sun to the spot.
    """
    return align(setups, effects, latitude_deg=latitude_deg, dtype=dtype).images(optics, effects, view)
