"""A picture of a plant: the field from above, and tower, receivers and targets from the side."""

from collections.abc import Mapping
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from model.plant import Cylinder, Plant, TargetPlane, Tower
from model.receivers import Cavity, Panels
from service.drawing.pictures import png

Array = NDArray[np.float64]

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


def surface_lines(surface: Cylinder | TargetPlane | Panels | Cavity) -> list[Array]:
    """Outlines (n, 3) [m] of a surface."""
    if isinstance(surface, Cylinder):
        return _cylinder_lines(surface)
    if isinstance(surface, Panels):
        return [_rectangle(panel) for panel in surface.panels]
    if isinstance(surface, Cavity):
        opening = np.concatenate([surface.aperture, surface.aperture[:1]])
        return [opening, *(_rectangle(panel) for panel in surface.panels)]
    return [_rectangle(surface)]


def _rectangle(plane: TargetPlane) -> Array:
    half = np.array([plane.width, plane.height]) / 2
    return plane.to_enu(np.array([(-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1)]) * half)


def _cylinder_lines(cylinder: Cylinder) -> list[Array]:
    """Both rims, and the lines along the axis at the ends and the sides."""
    half = np.radians(cylinder.opening_deg) / 2
    angles = np.linspace(-half, half, _ARC_POINTS)[:, None]
    outward = np.cos(angles) * cylinder.normal + np.sin(angles) * cylinder.right
    middle = cylinder.center + cylinder.radius * (outward - cylinder.normal)
    low, high = (middle + sign * cylinder.height / 2 * cylinder.up for sign in (-1, 1))
    ends = range(0, _ARC_POINTS, (_ARC_POINTS - 1) // 4)
    return [low, high, *(np.stack([low[end], high[end]]) for end in ends)]
