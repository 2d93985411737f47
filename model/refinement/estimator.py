"""Surface refinement: the maximum a posteriori surface, through the tracer.

Notes
-----
The heights of a mirror are ``z = mean + basis c``, with coefficients c of a prior that was
estimated from measured mirrors (`model.prior`). Image i is ``measured_i = images_i(c) + N_i n_i +
e_i``: what the tracer makes of the surface, nuisance parameters ``n_i ~ N(0, I)`` of the camera,
and errors ``e_i ~ N(0, S_i)`` (`whitening`). Marginalised over n, the negative log posterior is::

    cost(c) = (c' P c + r' r) / 2,   r = W (measured - images(c)),   W' W = (S + N N')^-1

with the prior's precision P. It is minimized by Levenberg-Marquardt steps (`model.least_squares`).
The Jacobian must be that of the images (`model.tracing.sensitivity`): a facet's canting changes an
image by one percent, and differences of coarse traces miss a third of this. The posterior
covariance at the minimum is ``C = (J' J + P)^-1`` with ``J = W d images / d c`` (`posterior`).

The stages, each of which can be called separately::

    images = ImageModel(heliostat, observations, model, prior)
    fit = fit_consistent_images(images, [np.zeros(len(prior.basis))], options)
    fit = add_ripples(fit)
    fit = estimate_hyperparameters(fit, options)
    linearization = linearize(fit.model, fit.mode)
    covariance = half_sample_covariance(fit.model, fit.mode, linearization, options)
    others = find_other_modes(fit.model, fit.mode, options)

1. `fit_consistent_images` anneals from each start with a few images (`modes`), takes the mode of
   the lowest cost, and excludes images that the others contradict, one by one.
2. `add_ripples` adds details that are finer than 8 x 8 heights (`model.prior.ripples`), to first
   order. Without them the heights would compensate what ripples do to the images: errors are three
   times as large or more.
3. `estimate_hyperparameters` estimates S and P from the residuals (empirical Bayes), and minimizes
   again.
4. `half_sample_covariance` widens the covariance by how much halves of the images disagree
   (`half_samples`).
5. `find_other_modes` widens the covariance of mirrors of many facets by how much surfaces with
   exchanged facets differ that explain the images too (`other_modes`).

S has one variance for each band of spatial frequency, times a factor for each image. Errors that
look like a bent mirror have more weight than S says; the overdispersion of the images' scores is
the factor.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from model import prediction_warnings
from model.errors import InvalidInputError
from model.observation import Observation, SurfacePrediction, misfits
from model.plant import Heliostat
from model.plant_model import PlantModel
from model.prior import SurfacePrior, prior_of
from model.progress import Progress, Steps, silent
from model.refinement.half_samples import half_sample_covariance, n_minimizations
from model.refinement.image_model import ImageModel
from model.refinement.modes import N_THREADS, RefinementOptions, find_mode, find_optimum
from model.refinement.other_modes import (
    between_mode_variance,
    find_other_modes,
    n_other_minimizations,
)
from model.refinement.posterior import FacetLight, Hyperparameters, Linearization, Mode, linearize
from model.surface import control_points

Array = NDArray[np.float64]

MIN_CROSS_VALIDATED, MAX_CROSS_VALIDATED = 2, 8
"""Numbers of images that each may be predicted from the others; more determine a mirror."""

DIMMING = 0.1
"""Share of a facet's light in finite differences of the images."""


@dataclass(frozen=True, eq=False)
class SurfaceFit:
    """A mode with the model of its images.

    Attributes
    ----------
    model : ImageModel
        Of the images that are used.
    mode : Mode
    excluded : tuple of int
        Places of the images that the others contradict.
    """

    model: ImageModel
    mode: Mode
    excluded: tuple[int, ...] = ()


def refine(
    heliostat: Heliostat,
    observations: Sequence[Observation],
    model: PlantModel,
    start: NDArray[np.float64] | None = None,
    *,
    prior: SurfacePrior | None = None,
    options: RefinementOptions | None = None,
    progress: Progress = silent,
) -> SurfacePrediction:
    """Estimate the most probable surface of a heliostat from its images.

    Parameters
    ----------
    heliostat : Heliostat
    observations : sequence of Observation
        Any number from one.
    model : PlantModel
    start : (F, 8, 8) [m], optional
        Where to begin in addition to the prior's mean: the network's prediction, say. The better
        result counts.
    prior : SurfacePrior, optional
        By default that of the heliostat's kind of facets.
    options : RefinementOptions, optional
    progress : callable
        Called before each trace; what it raises ends the refinement.

    Raises
    ------
    InvalidInputError
        Without images.
    """
    if not observations:
        raise InvalidInputError("a refinement takes at least one image")
    prior, options, steps = (
        prior or prior_of(heliostat),
        options or RefinementOptions(),
        Steps(progress),
    )
    steps.total = (
        options.rounds
        + options.with_half_samples * n_minimizations(len(observations))
        + n_other_minimizations(len(heliostat.facets), options)
    )
    images = ImageModel(
        heliostat,
        observations,
        model,
        prior,
        resolution=options.resolution,
        samples=options.samples_of(len(heliostat.facets)),
        steps=steps,
        threads=N_THREADS,
    )
    mean = np.zeros(len(prior.basis))
    fit = fit_consistent_images(
        images, [mean] if start is None else [prior.coefficients(start), mean], options
    )
    steps.phase = f"estimating the noise of {len(fit.model.observations)} images"
    if options.with_ripples:
        fit = add_ripples(fit)
    fit = estimate_hyperparameters(fit, options)
    linearization = linearize(fit.model, fit.mode)
    covariance = half_sample_covariance(fit.model, fit.mode, linearization, options)
    others = find_other_modes(fit.model, fit.mode, options)
    covariance += np.diag(between_mode_variance(prior, fit.mode.state.coefficients, others))
    smooth, _ = fit.model.split(fit.mode.state.coefficients)
    z = prior.surface(smooth)
    against = [
        *prediction_warnings.geometry_warnings(heliostat, observations),
        *prediction_warnings.canting_warnings(prior, z),
        *prediction_warnings.facet_light_warnings(*estimate_facet_light(fit, linearization)),
    ]
    return SurfacePrediction(
        z=z,
        z_std=prior.deviation(covariance),
        control_points=control_points(heliostat, z),
        method="refined",
        weights=prior.name,
        misfits=misfits(heliostat, observations, z, model),
        used=tuple(o.identifier for o in observations),
        information_shares=_information_shares(fit, linearization),
        mahalanobis_distance=prior.mahalanobis(z),
        contradicting=tuple(observations[i].identifier for i in fit.excluded),
        warnings=tuple(against),
        is_start_better=start is not None and _is_start_better(fit, linearization, start),
    )


def fit_consistent_images(
    images: ImageModel, starts: Sequence[Array], options: RefinementOptions
) -> SurfaceFit:
    """Find a mode, and exclude images that the others contradict, one by one.

    ``starts`` are coefficients (K,).
    """
    used, excluded = list(range(len(images.observations))), list[int]()
    while True:
        some = images.subset(used)
        mode = find_mode(some, starts, options)
        place = linearize(some, mode).find_contradicting()
        if place is None:
            return SurfaceFit(some, mode, tuple(excluded))
        excluded.append(used.pop(place))


def add_ripples(fit: SurfaceFit) -> SurfaceFit:
    """Add the coefficients of ripples, which are zero at first."""
    state, hyper = fit.mode.state, fit.mode.hyper
    model = fit.model.with_ripples(state, fit.mode.whitener(fit.model))
    count = len(model.ripples)
    state = replace(state, coefficients=np.concatenate([state.coefficients, np.zeros(count)]))
    hyper = replace(hyper, precision=np.concatenate([hyper.precision, np.ones(count)]))
    return replace(fit, model=model, mode=replace(fit.mode, state=state, hyper=hyper))


def estimate_hyperparameters(fit: SurfaceFit, options: RefinementOptions) -> SurfaceFit:
    """Estimate noise and prior scales from the residuals, and minimize again, in several rounds.

    The last round multiplies the noise by the overdispersion.
    """
    model, mode, prior = fit.model, fit.mode, fit.model.prior
    for n_left in reversed(range(options.rounds)):
        linearization = linearize(model, mode)
        if n_left:
            sigma = linearization.estimate_sigma()
        else:
            sigma = mode.hyper.sigma * np.sqrt(max(linearization.overdispersion(), 1.0))
        smooth, _ = model.split(mode.state.coefficients)
        variance, _ = model.split(np.diag(linearization.covariance))
        _, of_ripples = model.split(mode.hyper.precision)
        precision = np.concatenate([prior.precision(smooth, variance), of_ripples])
        hyper = Hyperparameters(np.maximum(sigma, options.min_sigma), precision)
        mode = find_optimum(model, replace(mode, hyper=hyper), options.minimizer)
    return replace(fit, mode=mode)


def estimate_facet_light(fit: SurfaceFit, linearization: Linearization) -> FacetLight:
    """Estimate how much light each facet sends, together with the surface."""
    whitener = fit.mode.whitener(fit.model)
    return linearization.facet_light(
        whitener(fit.model.dim_facets(fit.mode.state, DIMMING)) / DIMMING
    )


def _is_start_better(fit: SurfaceFit, linearization: Linearization, start: Array) -> bool:
    """Whether a few images agree better with the ``start`` (F, 8, 8) [m] than with the surface
    from the other images.

    The start is the network's, whose learnt errors are small where a few images leave much open.
    """
    model = fit.model
    if not MIN_CROSS_VALIDATED <= len(model.observations) <= MAX_CROSS_VALIDATED:
        return False
    smooth, nothing = model.prior.coefficients(start), np.zeros(len(model.ripples))
    state = model.state(np.concatenate([smooth, nothing]))
    by_start = fit.mode.whitener(model)(model.measured - state.images)
    by_others = linearization.leave_one_out_residuals()
    return bool((by_start**2).mean() < (by_others**2).mean())


def _information_shares(fit: SurfaceFit, linearization: Linearization) -> tuple[float, ...]:
    """Share of each image in the information of all; zero for excluded ones."""
    shares = np.zeros(len(fit.model.observations) + len(fit.excluded))
    shares[[i for i in range(len(shares)) if i not in fit.excluded]] = (
        linearization.information_shares()
    )
    return tuple(shares.tolist())
