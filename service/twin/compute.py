"""What the command line, the demo and REST do, as plain functions: measure, predict, forecast, study."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from datetime import datetime

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from model.effects import Effect, model_version
from model.fleet import Engine, FleetFlux, Superposition, Tile
from model.fleet import superpose as superpose_tiles
from model.forecast import Setup, View, align
from model.imaging import Camera, ImageKind, MeasuredFlux
from model.imaging import measure as measure_image
from model.network.architecture import MAX_IMAGES
from model.network.predictor import default_predictor
from model.observation import Observation, SurfacePrediction, render_observations, spread_suns
from model.plant import Heliostat, Receiver, TargetPlane
from model.refinement import refine
from model.study import FluxImage, Study, StudyOptions
from model.study import study as study_photographs
from model.surface import COLUMNS, DEGREE, ROWS, control_points
from model.tracing import Optics
from model.tracing.convolution import central_rays
from service.base.choices import Method, require_images
from service.base.progress import Progress, quiet
from service.sources.juelich import CENTERED_WINDOW, mark_layouts

Array = NDArray[np.float64]


SAMPLES = 64
"""Points along each side of a facet: measured surfaces of 20 x 20 control points converge to 0.2 % (L1)."""

MODEL_VERSION = model_version(())
"""Version of a plant's model that holds no effect."""


def measure(
    image: NDArray[np.uint8] | NDArray[np.uint16],
    kind: ImageKind,
    plane: TargetPlane,
    *,
    corners: Array | None = None,
    camera: Camera | None = None,
) -> MeasuredFlux:
    """Flux and quality of one photograph of a target; see `model.imaging.measure`."""
    layouts = mark_layouts(plane.name)
    return measure_image(image, kind, plane, layouts=layouts, side=CENTERED_WINDOW, corners=corners, camera=camera)


def predict(
    heliostat: Heliostat,
    observations: Sequence[Observation],
    method: Method = "network",
    optics: Optics | None = None,
    effects: Sequence[Effect] = (),
    *,
    latitude_deg: float,
) -> SurfacePrediction:
    """The mirror surface of a heliostat from its images, by the network alone or refined through the tracer.

    ``optics`` and ``effects`` are those of the model that is believed, ``latitude_deg`` [deg] is the plant's.

    Raises
    ------
    InvalidInputError
        For no or too many images, or an unknown method.
    """
    require_images(method, len(observations))
    predictor = default_predictor()
    if method == "network":
        return predictor.predict(heliostat, observations, optics, effects, latitude_deg=latitude_deg)
    far_apart = spread_suns(np.array([o.sun for o in observations]), MAX_IMAGES)
    few = [observations[place] for place in far_apart]
    start, _ = predictor.heights(heliostat, few, optics, effects, latitude_deg=latitude_deg)
    refined = refine(heliostat, observations, start, latitude_deg=latitude_deg, optics=optics, effects=effects)
    return replace(refined, weights=f"{predictor.name}+{refined.weights}")


def render(
    heliostat: Heliostat,
    observations: Sequence[Observation],
    z: ArrayLike | None,
    optics: Optics | None = None,
    effects: Sequence[Effect] = (),
    *,
    latitude_deg: float,
) -> Array:
    """What a surface (F, 8, 8) [m], None the ideal one, would have thrown where M fluxes were observed.

    (M, 64, 64), each with sum 100, in the observations' own windows.
    """
    heights = np.zeros((len(heliostat.facets), ROWS, COLUMNS)) if z is None else np.asarray(z, dtype=np.float64)
    return render_observations(heliostat, observations, heights, optics, effects, latitude_deg=latitude_deg)


@dataclass(frozen=True, eq=False)
class Forecast:
    """Flux of one heliostat on a plane: light, and what a camera would show of it.

    Attributes
    ----------
    flux : (rows, columns) float32 [W/m2]
        Light, whatever the camera.
    center_of_mass : (2,) [m]
        Right and up of the plane's centre.
    peak : float [W/m2]
    power : float [W]
        On the imaged part of the plane.
    model_version : str
        Version of the plant's model and the effects it holds.
    camera_view : (rows, columns) float32
        What the camera shows of that light, by the model's effects: the light itself where it holds none of a camera.
        This is what photographs are held against.
    """

    flux: NDArray[np.float32]
    center_of_mass: Array
    peak: float
    power: float
    camera_view: NDArray[np.float32]
    model_version: str = MODEL_VERSION


def forecast(
    heliostat: Heliostat,
    z: ArrayLike | None,
    sun: ArrayLike,
    plane: TargetPlane,
    *,
    aim: ArrayLike | None = None,
    spot: ArrayLike | None = None,
    angles: ArrayLike | None = None,
    resolution: tuple[int, int] = (256, 256),
    window: float | None = None,
    optics: Optics | None = None,
    surface: tuple[ArrayLike, int] | None = None,
    effects: Sequence[Effect] = (),
    latitude_deg: float,
    taken_at: datetime | None = None,
) -> Forecast:
    """Trace the flux of a heliostat on a plane by its model, with its effects.

    Parameters
    ----------
    z : array_like (4, 8, 8) [m], or None
        Heights over the canted facets; None for the ideal surface.
    sun : array_like (3,)
        Unit vector towards the sun in ENU.
    aim : array_like (3,) [m], optional
        Where the ray from the mirror's centre goes; the plane's centre unless given.
    spot : array_like (3,) [m], optional
        Where the spot's centre of mass shall lie; the heliostat is turned until it does. Goes before ``angles``.
    angles : array_like (2,) [rad], optional
        The mount's axis angles, as its motors tell them. Goes before ``aim``.
    resolution : (rows, columns)
    window : float [m], optional
        Side of a square about the spot; the whole plane unless given.
    surface : (control points (F, I, J, 3) [m], degree), optional
        A measured surface in place of ``z``.
    effects : sequence of Effect
    latitude_deg : float [deg]
        Of the plant.
    taken_at : datetime, optional
        When, for effects that come and go; the plant of today without it.

    Raises
    ------
    UnreachableError
        Where no attitude reflects the sun to the plane.
    """
    points, degree = (control_points(heliostat, z), DEGREE) if surface is None else surface
    shot = Setup(
        heliostat,
        np.asarray(points, dtype=np.float64),
        np.asarray(sun, dtype=np.float64),
        plane,
        spot=None if spot is None else np.asarray(spot, dtype=np.float64),
        angles=None if angles is None else np.asarray(angles, dtype=np.float64),
        aim=None if aim is None else np.asarray(aim, dtype=np.float64),
        degree=degree,
        taken_at=taken_at,
    )
    view = View(*resolution, window=window, samples=SAMPLES, padding=0.5, cones="facet")
    aligned = align([shot], effects, latitude_deg=latitude_deg, dtype=torch.float64)
    with torch.no_grad():
        light = aligned.flux(optics, effects, view)
        flux, shown = (_smooth(image[0]) for image in (light, aligned.camera_images(light, effects, view)))
        center = central_rays(aligned.groups[0].scene, SAMPLES).spot
    return Forecast(
        flux=flux,
        center_of_mass=center[0].numpy(),
        peak=float(flux.max()),
        power=float(flux.sum(dtype=np.float64) * np.prod(view.of(plane).pixel)),
        camera_view=shown,
        model_version=model_version(effects),
    )


def _smooth(image: torch.Tensor) -> NDArray[np.float32]:
    """An image (rows, columns) without the ripples of some 1e-5 of its peak that frequency space leaves below zero.

    The energy stays, so that no forecast holds more power than the mirror reflects.
    """
    positive = image.clamp(min=0)
    total = positive.sum()
    kept = positive * (image.sum().clamp(min=0) / total) if total > 0 else positive
    return np.asarray(kept.float().numpy())


def superpose(
    receiver: Receiver,
    tiles: Iterable[Tile],
    *,
    resolution: tuple[int, int] = (256, 256),
    optics: Optics | None = None,
    effects: Sequence[Effect] = (),
    latitude_deg: float,
    engine: Engine | None = None,
) -> FleetFlux:
    """The light [W/m2] of many heliostats on one receiver; see `model.fleet`."""
    task = Superposition(receiver, resolution, optics or Optics(), tuple(effects), latitude_deg=latitude_deg)
    return superpose_tiles(task, tiles, engine)


def study(
    photographs: Sequence[FluxImage],
    optics: Optics,
    effects: Sequence[Effect] = (),
    options: StudyOptions | None = None,
    progress: Progress = quiet,
    *,
    latitude_deg: float,
) -> Study:
    """Which effects photographs demand that a model with these optics and effects lacks; see `model.study.study`."""
    return study_photographs(photographs, optics, effects, options, progress, latitude_deg=latitude_deg)
