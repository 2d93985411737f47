"""Generic terms on the forecasts of photographs: their derivatives, and exact changes.

Forecasts are cuts about the spots' centres of mass. After each change
(`model.effects.generic_kinds`) they are centred again and scaled to sum one (`SpotImages.settle`),
as photographs are.
"""

from collections.abc import Callable, Iterator, Sequence
from copy import copy
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from model.effects import Effect, apply_optics_effects, effects_of_stage
from model.effects.generic_kinds import (
    IMAGE_KINDS,
    SUN_SIZE,
    GenericKind,
    SpotImages,
    beam_turns,
    changed_images,
    deformed,
    height_shapes,
    light_shapes,
    mirror_kinds,
)
from model.forecast import Aligned, View
from model.images import COARSE_SIZE, FLUX_SIZE
from model.study.flux_images import FluxImage, Forecaster, centers
from model.study.judging import Rows
from model.tracing import Optics, Scene, Window
from model.tracing.beam import N_TURNS
from model.tracing.convolution import beam_moves, central_rays, raster, splat
from model.tracing.scene import irradiance_of, optics_of
from model.tracing.sensitivity import sensitivity

Array = NDArray[np.float64]

AT_ONCE = 4
"""Photographs whose derivatives are in memory at once."""

STEPS = {"places": 0.02, "sun": 0.02}
"""Movement [m] of facets, and change [1] of the sun's size, in their finite differences."""


class GenericModel:
    """Applies generic terms to the forecasts of photographs under some effects."""

    def __init__(self, forecaster: Forecaster, effects: Sequence[Effect], view: View) -> None:
        self.forecaster = forecaster
        self.view = replace(view, rows=FLUX_SIZE, columns=FLUX_SIZE, window=forecaster.window)
        self.cuts = forecaster.cuts(effects)
        self.aligned: Aligned = forecaster.aligned(effects)
        self.flux_images: Sequence[FluxImage] = forecaster.flux_images
        self.planes = forecaster.planes
        self.places = np.concatenate(
            [centers(p.image[None], [p.setup.plane]) for p in self.flux_images]
        )
        self.moves, self.slant_range = _light_moves(self.aligned)
        first = self.aligned.groups[0].scene.control_points[0]
        facets = first.mean(dim=(-2, -1))[:, :2].double().numpy()
        is_alike = len({len(p.setup.control_points) for p in self.flux_images}) == 1
        traced = [*(mirror_kinds(facets) if is_alike else []), SUN_SIZE]
        self.traces = TracedTerms(forecaster, self.aligned, self.view, traced)
        self.kinds = [*IMAGE_KINDS, *traced]

    def of_kind(self, kind: GenericKind) -> "GenericModel":
        """The same for one kind: it traces no others where it traces photographs first."""
        model = copy(self)
        model.traces = TracedTerms(self.forecaster, self.aligned, self.view, [kind])
        return model

    def spots(self, rows: Rows, cuts: Array) -> SpotImages:
        """The geometry of some photographs with cuts (n, 64, 64)."""
        window = self.forecaster.window
        return SpotImages(
            images=cuts,
            size=(window, window),
            places=self.places[rows] * [1, -1],
            half=np.array([self.planes[row].width / 2 for row in rows.tolist()])[:, None, None],
            slant_range=self.slant_range[rows],
            window=window,
            moves=self.moves[rows],
        )

    def _parts(self, rows: Rows, cuts: Array) -> Iterator[tuple[Rows, Rows, SpotImages]]:
        """A few photographs at once: their places among ``rows``, their rows and geometry."""
        for part in np.array_split(np.arange(len(rows)), -(-len(rows) // AT_ONCE)):
            yield part, rows[part], self.spots(rows[part], cuts[part])

    def derivatives(
        self, kind: GenericKind, rows: Rows, cuts: Array, coefficients: Array
    ) -> NDArray[np.float32]:
        """Derivatives (n, K, S, S) of cuts (n, 64, 64) with a kind's coefficients (n, K).

        They are of the photographs ``rows`` (n,), and binned to S = `COARSE_SIZE`.
        """
        shape = (len(rows), len(kind.components), COARSE_SIZE, COARSE_SIZE)
        found = np.empty(shape, dtype=np.float32)
        for part, some, spots in self._parts(rows, cuts):
            for number, change in enumerate(self._changes(kind, spots, some, coefficients[part])):
                found[part, number] = spots.settled_change(change)
        return found

    def _changes(
        self, kind: GenericKind, spots: SpotImages, rows: Rows, coefficients: Array
    ) -> Iterator[Array]:
        """Changes (n, 64, 64) of cuts by each component."""
        if kind.basis is None:
            yield from self.traces.changes(kind, rows, coefficients)
            return
        for part in kind.basis(spots):
            if kind.operator == "transfer":
                yield spots.filtered(part)
            elif kind.operator == "warp":
                yield -(part.swapaxes(0, 1) * spots.slopes).sum(axis=0)
            else:
                yield part * (spots.images if kind.operator == "scale" else spots.peaks)

    def apply(self, kind: GenericKind, rows: Rows, cuts: Array, coefficients: Array) -> Array:
        """Cuts (n, 64, 64) of the photographs ``rows`` (n,) with a kind's coefficients (n, K)."""
        found = np.empty_like(cuts)
        for part, some, spots in self._parts(rows, cuts):
            found[part] = spots.settle(self._applied(kind, spots, some, coefficients[part]))
        return found

    def _applied(
        self, kind: GenericKind, spots: SpotImages, rows: Rows, coefficients: Array
    ) -> Array:
        if kind.basis is not None:
            return changed_images(kind, spots, coefficients)
        if kind.operator == "light":
            changes = self.traces.changes(kind, rows, coefficients)
            return np.asarray(spots.images + np.einsum("nk,knij->nij", coefficients, changes))
        return np.asarray(spots.images + self.traces.deformation(kind, rows, coefficients))


class TracedTerms:
    """Traces changes by ``kinds`` of generic terms, of the mirrors and the sun, in forecasts."""

    def __init__(
        self, forecaster: Forecaster, aligned: Aligned, view: View, kinds: Sequence[GenericKind]
    ) -> None:
        self.forecaster, self.aligned, self.view, self.kinds = forecaster, aligned, view, kinds
        self.scenes = [
            one.scene.with_(beam_turns=beam_turns(one.setups, one.scene)) for one in aligned.groups
        ]
        self._cached: dict[bytes, dict[str, NDArray[np.float32]]] = {}
        self._plain: dict[bytes, Array] = {}

    def changes(self, kind: GenericKind, rows: Rows, coefficients: Array) -> Array:
        """Changes (K, n, 64, 64) of the cuts that have coefficients (n, K)."""
        if kind.operator in ("heights", "sun") and coefficients.any():
            return self._traced([kind], rows, coefficients)
        return np.asarray(self._unchanged(rows)[kind.name], dtype=np.float64)

    def _unchanged(self, rows: Rows) -> dict[str, NDArray[np.float32]]:
        """Changes of cuts without coefficients, by kind; they are traced once for all cuts."""
        key = rows.tobytes()
        if key not in self._cached:
            ends = np.cumsum([len(kind.components) for kind in self.kinds])
            changes = self._traced(self.kinds, rows, np.zeros((len(rows), 0)))
            parts = np.split(changes.astype(np.float32), ends[:-1])
            names = [kind.name for kind in self.kinds]
            self._cached[key] = dict(zip(names, parts, strict=True))
        return self._cached[key]

    def _traced(self, kinds: Sequence[GenericKind], rows: Rows, coefficients: Array) -> Array:
        """Changes (K, n, 64, 64) by all kinds, of cuts that have coefficients of the first."""
        view, (first, *_) = self.view, kinds
        heights, light = (
            [np.asarray(kind.weights) for kind in kinds if kind.operator == operator]
            for operator in ("heights", "light")
        )

        def trace(scene: Scene, window: Window, optics: Optics, amounts: Tensor) -> Tensor:
            shapes = height_shapes(scene)
            if amounts.any():
                scene = deformed(scene, [first], amounts)
            found = [view.trace(scene, window, optics)[None]]
            if heights:
                weights = torch.as_tensor(np.concatenate(heights))
                by_heights = partial(sensitivity, shapes=shapes, weights=weights)
                found.append(
                    by_heights(scene, window, optics, samples=view.samples, padding=view.padding)
                )
            if light:
                weights = torch.as_tensor(np.concatenate(light)).to(scene.sun)
                found.append(_light_changes(scene, window, optics, view, weights))
            for kind in kinds:
                if kind.operator in STEPS:
                    size = STEPS[kind.operator]
                    steps = (size * torch.eye(len(kind.components)).double()).unbind()
                    moved = (deformed(scene, [kind], row.expand(scene.batch, -1)) for row in steps)
                    images = [view.trace(one, window, optics)[None] for one in moved]
                    found += [(image - found[0]) / size for image in images]
            return torch.cat(found)

        images = self._each_part(rows, coefficients, trace)
        if not coefficients.any():
            self._plain[rows.tobytes()] = images[0].copy()
        return np.asarray(images[1:] / images[0].sum(axis=(1, 2), keepdims=True))

    def deformation(self, kind: GenericKind, rows: Rows, coefficients: Array) -> Array:
        """Change (n, 64, 64) of the cuts by coefficients (n, K) of a kind."""

        def trace(scene: Scene, window: Window, optics: Optics, amounts: Tensor) -> Tensor:
            mirrors = deformed(scene, [kind], amounts) if amounts.any() else scene
            return self.view.trace(mirrors, window, optics)[None]

        key = rows.tobytes()
        if key not in self._plain:
            (self._plain[key],) = self._each_part(rows, np.zeros_like(coefficients), trace)
        plain, (changed,) = self._plain[key], self._each_part(rows, coefficients, trace)
        return np.asarray((changed - plain) / plain.sum(axis=(1, 2), keepdims=True))

    def _each_part(
        self,
        rows: Rows,
        coefficients: Array,
        trace: Callable[[Scene, Window, Optics, Tensor], Tensor],
    ) -> Array:
        """Images (M, n, 64, 64) of some photographs, traced with their coefficients."""
        places = {row: place for place, row in enumerate(rows.tolist())}
        found, order = [], []
        optics_effects = effects_of_stage(self.aligned.model.effects, "optics")
        for group, scene in zip(self.aligned.groups, self.scenes, strict=True):
            for window, there, alike in group.parts(self.view.windows_on(group), optics_effects):
                some = [place for place in alike if group.rows[place] in places]
                if not some:
                    continue
                self.forecaster.between()
                own = [places[group.rows[place]] for place in some]
                optics = apply_optics_effects(there, self.aligned.model.optics)
                amounts = torch.as_tensor(coefficients[own])
                with torch.no_grad():
                    found.append(trace(scene.subset(some), window, optics, amounts).numpy())
                order += own
        return np.asarray(np.concatenate(found, axis=1)[:, np.argsort(order)])


def _light_changes(
    scene: Scene, window: Window, optics: Optics, view: View, weights: Tensor
) -> Tensor:
    """Changes (K, n, R, C) of irradiance by facets' light with ``weights`` (K, F, L)."""
    rays = central_rays(scene, view.samples)
    optics = optics_of(scene, optics)
    irradiance = irradiance_of(scene, optics, rays.slant_range)
    on_grid = raster(rays, rays.spot, window, optics, irradiance, (view.padding, view.padding))
    shapes = light_shapes(view.samples).flatten(1).to(rays.power)
    changes: Tensor | float = 0.0
    for facet, amounts in enumerate(weights.unbind(1)):
        x, y, weight = (
            rays.view(scene.batch, weights.shape[1], -1)[:, facet]
            for rays in (on_grid.x, on_grid.y, on_grid.weight)
        )
        images = [splat(x, y, weight * shares, *on_grid.shape) for shares in shapes]
        changes = changes + torch.einsum("kl,lnij->knij", amounts, torch.stack(images))
    return on_grid.blurred(torch.as_tensor(changes))


class _LightMoves(NamedTuple):
    """How far light moves (N, 4, 2) [m/mrad] with the turns of `model.tracing.beam`; slant ranges
    (N,) [m].
    """

    moves: Array
    slant_range: Array


def _light_moves(aligned: Aligned) -> _LightMoves:
    count = sum(len(group.rows) for group in aligned.groups)
    found = _LightMoves(np.zeros((count, N_TURNS, 2)), np.zeros(count))
    for group in aligned.groups:
        scene, rays = group.scene, central_rays(group.scene, 2)
        moves = beam_moves(scene, beam_turns(group.setups, scene), rays.direction, rays.slant_range)
        found.moves[group.rows] = moves.double().numpy()
        found.slant_range[group.rows] = rays.slant_range.double().numpy()
    return found
