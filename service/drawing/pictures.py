"""Pictures of flux maps, surfaces and plants as PNG, without matplotlib's global state.

A plant's field is seen from above, and tower, receivers and targets from the side.
"""

import io
from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from model.plant import Cylinder, Plant, TargetPlane, Tower
from model.receivers import Cavity, Panels
from model.surface import DEGREE, basis
from service.drawing.facets import FacetPlaces

Array = NDArray[np.floating]


def png(figure: Figure) -> bytes:
    """The figure as a PNG file."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()


def _extend(values: Array, low: float, high: float) -> str:
    """The ``extend`` of a matplotlib colour bar: the sides on which values lie beyond it."""
    is_below, is_above = bool(np.nanmin(values) < low), bool(np.nanmax(values) > high)
    return {(True, True): "both", (True, False): "min", (False, True): "max"}.get(
        (is_below, is_above), "neither"
    )


def flux_picture(flux: Array, size: tuple[float, float] | None, unit: str, title: str) -> bytes:
    """A flux map (rows, columns) in colours, with axes in m or pixels.

    ``size`` is its width and height [m]; None gives pixels.
    """
    return map_picture(flux, size, title, "inferno", (0.0, None), unit)


def map_picture(
    values: Array,
    size: tuple[float, float] | None,
    title: str,
    colours: str,
    bounds: tuple[float, float | None],
    label: str,
    facets: FacetPlaces | None = None,
) -> bytes:
    """A map (rows from the top, columns) in a colour map of matplotlib.

    ``bounds`` are the ends of the colour scale; an upper end of None is the largest value.
    The map of a mirror is of the rectangle around its ``facets``, whose edges are drawn.
    """
    ratio = np.shape(values)[0] / np.shape(values)[1] if size is None else size[1] / size[0]
    figure = Figure(figsize=(6, float(np.clip(4.4 * ratio + 0.8, 2.6, 5))), layout="constrained")
    axes = figure.subplots()
    draw_map(axes, values, size, colours, bounds, label, facets)
    axes.set_title(title, wrap=True)
    return png(figure)


def draw_map(
    axes: Axes,
    values: Array,
    size: tuple[float, float] | None,
    colours: str,
    bounds: tuple[float, float | None],
    label: str,
    facets: FacetPlaces | None = None,
) -> None:
    """Draw the map of `map_picture` with its colour bar into axes of matplotlib."""
    extent = None if size is None else (-size[0] / 2, size[0] / 2, -size[1] / 2, size[1] / 2)
    if facets is not None:
        (left, bottom), (right, top) = facets.box.tolist()
        extent = (left, right, bottom, top)
        for edge in facets.edges():
            axes.plot(*np.concatenate([edge, edge[:1]]).T, color="gray", linewidth=0.5)
    low, high = bounds[0], float(np.nanmax(values)) if bounds[1] is None else bounds[1]
    image = axes.imshow(values, cmap=colours, vmin=low, vmax=high, extent=extent, aspect="equal")
    axes.set(xlabel="right [m]" if size else "column", ylabel="up [m]" if size else "row")
    axes.figure.colorbar(image, ax=axes, label=label, extend=_extend(values, low, high))


def places_picture(
    places: Array, values: Array, title: str, colours: str, bounds: tuple[float, float]
) -> bytes:
    """Values at ``places`` (n, 2), east and north [m], as coloured dots.

    Values that are not finite are hollow dots.
    """
    figure = Figure(figsize=(7, 7), layout="constrained")
    draw_places(figure.subplots(), places, values, colours, bounds, title)
    return png(figure)


def draw_places(
    axes: Axes, places: Array, values: Array, colours: str, bounds: tuple[float, float], label: str
) -> None:
    """Draw the dots of `places_picture` into axes, with a colour bar if a value is known."""
    known, (east, north) = np.isfinite(values), places.T
    axes.scatter(east[~known], north[~known], s=14, facecolors="none", edgecolors="gray")
    low, high = bounds
    shown = axes.scatter(
        east[known], north[known], s=14, c=values[known], cmap=colours, vmin=low, vmax=high
    )
    axes.set(xlabel="east of the tower [m]", ylabel="north [m]", aspect="equal")
    if known.any():
        axes.figure.colorbar(shown, ax=axes, label=label)


def series_picture(
    title: str, unit: str, series: Mapping[str, tuple[Sequence[Any], Sequence[float]]]
) -> bytes:
    """Values over times or names, one line for each of ``series``."""
    figure = Figure(figsize=(8, 4), layout="constrained")
    axes = figure.subplots()
    for name, (places, values) in series.items():
        axes.plot(places, values, "o-", label=name)
    axes.set(title=title, ylabel=unit)
    axes.tick_params("x", rotation=30)
    axes.grid(alpha=0.3)
    if len(series) > 1:
        axes.legend()
    return png(figure)


def photograph_picture(
    pixels: NDArray[np.generic], most: int, corners: Array | None = None
) -> bytes:
    """A photograph, gray or RGB, as JPEG of at most ``most`` pixels per side.

    ``corners`` (4, 2) [px], upper left, upper right, lower left, lower right, are drawn as an
    outline.
    """
    image = np.asarray(pixels)
    largest = 255.0 if image.dtype == np.uint8 else max(float(image.max()), 1.0)
    scale = min(1.0, most / max(image.shape[:2]))
    if scale < 1:  # resize first: the next steps need several times the image's memory
        image = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    if image.dtype != np.uint8:  # 16-bit images are scaled to their maximum
        image = (image.astype(np.float32) * (255 / largest)).astype(np.uint8)
    image = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR if image.ndim == 2 else cv2.COLOR_RGB2BGR)
    if corners is not None:
        outline = np.round((np.asarray(corners) * scale)[[0, 1, 3, 2]]).astype(np.int32)
        cv2.polylines(
            image, [outline], isClosed=True, color=(64, 220, 255), thickness=2, lineType=cv2.LINE_AA
        )
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 85])[1].tobytes()


def mirror_heights(z: Array, samples: int = 48) -> NDArray[np.float64]:
    """Heights (4, samples, samples) [mm] of control heights (4, 8, 8) [m], evenly spaced.

    Control heights are denser near the facet's edges, which would distort a picture.
    """
    across, along = (
        basis(count, DEGREE, np.linspace(0, 1, samples))[0] for count in np.shape(z)[1:]
    )
    return across @ np.asarray(z, dtype=np.float64) @ along.T * 1e3


def surface_picture(z: Array, title: str, bound: float, places: FacetPlaces) -> bytes:
    """A surface of control heights (F, 8, 8) [m] as a map in mm, seen from the front.

    ``bound`` [mm] is the end of the scale on both sides; heights beyond it have the end colours.
    """
    width, height = np.ptp(places.box, axis=0).tolist()
    label = "deviation from the ideal facet [mm]"
    image = places.image(mirror_heights(z))
    return map_picture(image, (width, height), title, "RdBu_r", (-bound, bound), label, places)


def of_peak(measured: Array, forecast: Array) -> Array:
    """Both fluxes (2, n, n), scaled to the same sum, as shares of the measured peak."""
    a, b = measured / measured.sum(), forecast / forecast.sum()
    return np.stack([a, b]) / float(a.max())


def comparison_picture(
    measured: Array, forecast: Array, side: float, title: str, bounds: tuple[float, float]
) -> bytes:
    """Pictures of measured flux, forecast flux (n, n) and their difference, over ``side`` [m].

    The fluxes are scaled to the same sum. ``bounds`` are the ends of the scales of flux and
    difference, relative to the measured peak.
    """
    a, b = of_peak(np.asarray(measured), np.asarray(forecast))
    top, bound = bounds
    figure = Figure(figsize=(10, 3.4), layout="constrained")
    panes = figure.subplots(1, 3)
    extent = (-side / 2, side / 2, -side / 2, side / 2)
    for pane, image, name in zip(panes, (a, b), ("measured", "forecast"), strict=False):
        shown = pane.imshow(image, cmap="inferno", vmin=0, vmax=top, extent=extent)
        pane.set(title=name, xlabel="right [m]")
    figure.colorbar(shown, ax=panes[:2].tolist(), label="of the measured peak")
    shown = panes[2].imshow(b - a, cmap="RdBu_r", vmin=-bound, vmax=bound, extent=extent)
    panes[2].set(title="forecast - measured", xlabel="right [m]")
    figure.colorbar(
        shown, ax=panes[2], label="of the measured peak", extend=_extend(b - a, -bound, bound)
    )
    figure.suptitle(title)
    return png(figure)


_ARC_POINTS = 73
_RECEIVER, _TARGET, _TOWER = "firebrick", "darkorange", "dimgray"
_COLOURS = "tab10"


def plant_picture(
    plant: Plant,
    receivers: Mapping[str, Cylinder | TargetPlane | Panels | Cavity],
    type_of: Mapping[str, str],
    tower: Tower | None,
) -> bytes:
    """A plant from above, its heliostats coloured by type, and its tower from the side.

    ``type_of`` has the names of types by heliostat.
    """
    figure = Figure(figsize=(12, 6.5), layout="constrained")
    above, side = figure.subplots(1, 2, width_ratios=(3, 2))
    _draw_field(above, plant, type_of)
    if tower is not None:
        above.add_patch(
            matplotlib.patches.Circle((0, 0), tower.radius, color=_TOWER, label="tower")
        )
    named = (("receivers", receivers, _RECEIVER), ("targets", plant.targets, _TARGET))
    for label, surfaces, colour in named:
        for line in (line for surface in surfaces.values() for line in surface_lines(surface)):
            above.plot(line[:, 0], line[:, 1], color=colour, lw=1.5, label=label)
            label = f"_{label}"  # one entry in the legend
    above.set(xlabel="east [m]", ylabel="north [m]", aspect="equal", title=plant.name)
    above.legend(loc="upper left", bbox_to_anchor=(0, -0.08), ncols=4, frameon=False)
    _draw_side(side, plant, receivers, tower)
    return png(figure)


def _draw_field(axes: Any, plant: Plant, type_of: Mapping[str, str]) -> None:
    """Mirrors as dots at their pylons, one colour a type."""
    places = {name: heliostat.position for name, heliostat in plant.heliostats.items()}
    palette = matplotlib.colormaps[_COLOURS].colors  # type: ignore[attr-defined]
    for number, kind in enumerate(dict.fromkeys(type_of.values())):
        of_kind = np.array([places[name] for name in places if type_of[name] == kind])
        size = 30 if len(places) < 500 else 6
        label = f"{kind} ({len(of_kind):,})"
        axes.scatter(
            of_kind[:, 0], of_kind[:, 1], s=size, color=palette[number % len(palette)], label=label
        )


def _draw_side(
    axes: Any,
    plant: Plant,
    receivers: Mapping[str, Cylinder | TargetPlane | Panels | Cavity],
    tower: Tower | None,
) -> None:
    """Tower, receivers and targets as seen from the north: east is left."""
    if tower is None:
        axes.plot([0, 0], [0, 1], ":", color=_TOWER, transform=axes.get_xaxis_transform())
        axes.annotate("no tower in the file", (0, 0), (8, 8), textcoords="offset points")
    else:
        axes.fill_between([-tower.radius, tower.radius], tower.height, color=_TOWER, alpha=0.5)
    for surfaces, colour in ((receivers, _RECEIVER), (plant.targets, _TARGET)):
        for name, surface in surfaces.items():
            lines = surface_lines(surface)
            for line in lines:
                axes.plot(line[:, 0], line[:, 2], color=colour, lw=1.5)
            points = np.concatenate(lines)
            middle = (points[:, 0].min(), (points[:, 2].min() + points[:, 2].max()) / 2)
            axes.annotate(
                name, middle, (8, 0), textcoords="offset points", color=colour, va="center"
            )
    axes.axhline(0, color="black", lw=0.8)
    axes.set(xlabel="east [m]", ylabel="up [m]", title="seen from the north")
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(x=0.6, y=0.08)
    axes.invert_xaxis()


def surface_lines(surface: Cylinder | TargetPlane | Panels | Cavity) -> list[NDArray[np.float64]]:
    """Outlines (n, 3) [m] of a surface."""
    if isinstance(surface, Cylinder):
        return _cylinder_lines(surface)
    if isinstance(surface, Panels):
        return [_rectangle(panel) for panel in surface.panels]
    if isinstance(surface, Cavity):
        opening = np.concatenate([surface.aperture, surface.aperture[:1]])
        return [opening, *(_rectangle(panel) for panel in surface.panels)]
    return [_rectangle(surface)]


def _rectangle(plane: TargetPlane) -> NDArray[np.float64]:
    half = np.array([plane.width, plane.height]) / 2
    return plane.to_enu(np.array([(-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1)]) * half)


def _cylinder_lines(cylinder: Cylinder) -> list[NDArray[np.float64]]:
    """Both rims, and the lines along the axis at the ends and the sides."""
    half = np.radians(cylinder.opening_deg) / 2
    angles = np.linspace(-half, half, _ARC_POINTS)[:, None]
    outward = np.cos(angles) * cylinder.normal + np.sin(angles) * cylinder.right
    middle = cylinder.center + cylinder.radius * (outward - cylinder.normal)
    low, high = (middle + sign * cylinder.height / 2 * cylinder.up for sign in (-1, 1))
    ends = range(0, _ARC_POINTS, (_ARC_POINTS - 1) // 4)
    return [low, high, *(np.stack([low[end], high[end]]) for end in ends)]
