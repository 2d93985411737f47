"""Operations of command line, demo and REST: measure, predict, forecast, superpose, study."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from model.effects import acting, apply_optics_effects, effects_of_stage, model_version
from model.fleet import Losses, losses_of, superpose
from model.forecast import Aligned, View, align
from model.imaging import Camera, ImageKind, MeasuredFlux
from model.imaging import measure as measure_image
from model.network.architecture import MAX_IMAGES
from model.network.networks import SHIPPED, Networks
from model.observation import Observation, SurfacePrediction, render_observations, spread_suns
from model.plant import Heliostat, TargetPlane
from model.plant_model import PlantModel
from model.progress import Progress, silent
from model.refinement import refine
from model.setup import Setup
from model.study import study
from model.surface import heights_or_ideal
from model.tracing.convolution import Rays, central_rays
from model.tracing.scene import irradiance_of
from model.tracing.superposition import Beams
from service.base.choices import Method, require_images
from service.sources.photograph import CENTERED_WINDOW, mark_layouts

__all__ = [
    "Forecast",
    "ModelOperations",
    "forecast",
    "has_network",
    "measure",
    "predict",
    "render",
    "study",
    "superpose",
]

Array = NDArray[np.float64]

SAMPLES = 64
"""Points along each side of a facet.

With measured surfaces of 20 x 20 control points the result is within 0.2 % (L1) of its limit.
"""

MODEL_VERSION = model_version(())
"""Version of a plant's model without effects."""


def measure(
    image: NDArray[np.uint8] | NDArray[np.uint16],
    kind: ImageKind,
    plane: TargetPlane,
    *,
    corners: Array | None = None,
    camera: Camera | None = None,
) -> MeasuredFlux:
    """Measure flux and quality of one photograph of a target; see `model.imaging.measure`."""
    layouts = mark_layouts(plane.name)
    return measure_image(
        image, kind, plane, layouts=layouts, side=CENTERED_WINDOW, corners=corners, camera=camera
    )


def predict(
    heliostat: Heliostat,
    observations: Sequence[Observation],
    model: PlantModel,
    method: Method = "network",
    progress: Progress = silent,
    *,
    networks: Networks = SHIPPED,
) -> SurfacePrediction:
    """Predict the mirror surface of a heliostat from its images.

    The network predicts it alone, or the prediction is refined through the tracer. If few images
    agree better with the network's surface than with one refined from the others, the network's is
    the answer. Mirrors that none of the ``networks`` was trained for are refined in either case:
    see `SurfacePrediction.method`. ``progress`` receives the progress of the refinement. An
    exception that it raises stops the refinement.

    Raises
    ------
    InvalidInputError
        If there are no or too many images, or the method is unknown.
    """
    require_images(method, len(observations))
    predictor = networks.of(heliostat)
    if predictor is None:
        return refine(heliostat, observations, model, progress=progress)
    if method == "network":
        return predictor.predict(heliostat, observations, model)
    far_apart = spread_suns(np.array([o.sun for o in observations]), MAX_IMAGES)
    few = [observations[place] for place in far_apart]
    start, _ = predictor.heights(heliostat, few, model)
    refined = refine(
        heliostat, observations, model, start, prior=predictor.prior, progress=progress
    )
    if refined.is_start_better:
        return predictor.predict(heliostat, few, model)
    return replace(refined, weights=f"{predictor.name}+{refined.weights}")


def has_network(heliostat: Heliostat, networks: Networks = SHIPPED) -> bool:
    """Whether a network was trained for a heliostat's kind of mirror."""
    return networks.of(heliostat) is not None


def render(
    heliostat: Heliostat,
    observations: Sequence[Observation],
    z: ArrayLike | None,
    model: PlantModel,
) -> Array:
    """Forecast the fluxes of M observations with a surface.

    ``z`` are heights (F, 8, 8) [m]; None is the ideal surface. The result is (M, 64, 64), each with
    sum 100, in the windows of the observations.
    """
    heights = heights_or_ideal(heliostat, z)
    return render_observations(heliostat, observations, heights, model)


@dataclass(frozen=True, eq=False)
class Forecast:
    """Flux of one heliostat on a plane, and what a camera would show of it.

    Attributes
    ----------
    flux : (rows, columns) float32 [W/m2]
        Irradiance, independent of the camera.
    center_of_mass : (2,) [m]
        Right and up of the plane's centre.
    peak : float [W/m2]
    power : float [W]
        On the mapped part of the plane.
    losses : Losses
        What becomes of the light, up to the whole plane.
    camera_view : (rows, columns) float32
        What the camera shows of this flux, by the model's effects. It equals the flux if the model
        has no camera effects. Photographs are compared with it.
    model_version : str
        Version of the plant's model and its effects.
    """

    flux: NDArray[np.float32]
    center_of_mass: Array
    peak: float
    power: float
    losses: Losses
    camera_view: NDArray[np.float32]
    model_version: str = MODEL_VERSION


def forecast(
    setup: Setup,
    model: PlantModel,
    resolution: tuple[int, int] = (256, 256),
    window: float | None = None,
) -> Forecast:
    """Trace the flux of one heliostat on a plane.

    Parameters
    ----------
    setup : Setup
    model : PlantModel
    resolution : (rows, columns)
    window : float [m], optional
        Side of a square about the spot; the whole plane by default.

    Raises
    ------
    UnreachableError
        If no attitude reflects the sun to the plane.
    """
    view = View(*resolution, window=window, samples=SAMPLES, padding=0.5, cones="facet")
    aligned = align([setup], model, dtype=torch.float64)
    with torch.no_grad():
        light = aligned.flux(view)
        flux, shown = (_smooth(image[0]) for image in (light, aligned.camera_images(light, view)))
        whole = view if window is None else replace(view, window=None)
        onto_plane = light if window is None else aligned.flux(whole)
        rays = central_rays(aligned.groups[0].scene, SAMPLES)
    intercepted = onto_plane.sum(dim=(-2, -1)) * float(np.prod(whole.window_on(setup.plane).pixel))
    return Forecast(
        flux=flux,
        center_of_mass=rays.spot[0].numpy(),
        peak=float(flux.max()),
        power=float(flux.sum(dtype=np.float64) * np.prod(view.window_on(setup.plane).pixel)),
        losses=_losses(aligned, rays, intercepted),
        camera_view=shown,
        model_version=model_version(model.effects),
    )


def _losses(aligned: Aligned, rays: Rays, intercepted: torch.Tensor) -> Losses:
    """Losses of the light of one setup, of which ``intercepted`` (1,) [W] reaches its plane."""
    (group,), model = aligned.groups, aligned.model
    (setup,) = group.setups
    optics_effects = effects_of_stage(model.effects, "optics")
    there = acting(optics_effects, setup.taken_at, setup.heliostat.name)
    optics = apply_optics_effects(there, model.optics)
    beams = Beams.of(rays, irradiance_of(group.scene, optics, rays.slant_range))
    found = losses_of([setup.heliostat], beams, intercepted, optics, setup.plane.absorptance)
    return found[setup.heliostat.name]


def _smooth(image: torch.Tensor) -> NDArray[np.float32]:
    """Remove negative ripples from an image (rows, columns), and keep its energy.

    The computation in frequency space leaves ripples of about 1e-5 of the peak. The energy is kept
    so that no forecast has more power than the mirror reflects.
    """
    positive = image.clamp(min=0)
    total = positive.sum()
    kept = positive * (image.sum().clamp(min=0) / total) if total > 0 else positive
    return np.asarray(kept.float().numpy())


class ModelOperations:
    """These operations, with the networks of a folder.

    Attributes
    ----------
    networks : Networks
    """

    measure = staticmethod(measure)
    render = staticmethod(render)
    forecast = staticmethod(forecast)
    superpose = staticmethod(superpose)
    study = staticmethod(study)

    def __init__(self, folder: Path) -> None:
        self.networks = Networks(folder)

    def predict(
        self,
        heliostat: Heliostat,
        observations: Sequence[Observation],
        model: PlantModel,
        method: Method = "network",
        progress: Progress = silent,
    ) -> SurfacePrediction:
        """`predict` with the networks of the folder."""
        return predict(heliostat, observations, model, method, progress, networks=self.networks)

    def has_network(self, heliostat: Heliostat) -> bool:
        """`has_network` with the networks of the folder."""
        return has_network(heliostat, self.networks)
