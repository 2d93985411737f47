"""Charts of the pages as plain numbers: maps, colour bars, time series, histories.

Templates turn them into SVG.
"""

import base64
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Protocol

import cv2
import matplotlib
import numpy as np
from matplotlib.colors import LinearSegmentedColormap, to_hex
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from service.drawing.facets import FacetPlaces
from service.drawing.pictures import map_picture, mirror_heights, series_picture

Array = NDArray[np.floating]

Sheet = tuple[Sequence[str], Sequence[Sequence[Any]]]
"""Columns and rows."""


class Figure(Protocol):
    """A figure with a ``title``, and the file ``formats`` that it can be downloaded in.

    The format ``csv`` needs ``sheet`` (columns and rows), ``npz`` needs ``arrays`` (by name), and
    ``png`` needs ``drawn()``.
    """

    formats: ClassVar[tuple[str, ...]]

    @property
    def title(self) -> str:
        """What the figure shows."""
        ...


@dataclass(frozen=True)
class Tick:
    """A labelled position on an axis: 0 at its low end, 1 at its high end."""

    at: float
    label: str


def ticks(low: float, high: float, most: int = 5) -> Sequence[Tick]:
    """Ticks at round numbers between ``low`` and ``high``, about ``most`` of them."""
    values = MaxNLocator(most, steps=[1, 2, 2.5, 5, 10]).tick_values(low, high)
    slack = 1e-9 * (high - low)
    inside = [value for value in values if low - slack <= value <= high + slack]
    return tuple(
        Tick((value - low) / (high - low), f"{round(value, 12) + 0.0:g}") for value in inside
    )


CONDITION = "heliotwin.condition"
"""Colour map from poor, red, to fine, a quiet blue. Each colour has a contrast of 3 to light and to
dark cards.
"""
matplotlib.colormaps.register(
    LinearSegmentedColormap.from_list(
        CONDITION, ["#d62020", "#d9541e", "#b98244", "#8a929a", "#5b95b8"]
    )
)
matplotlib.colormaps.register(matplotlib.colormaps[CONDITION].reversed(f"{CONDITION}_r"))


@dataclass(frozen=True)
class ColourScale:
    """Colour scale: a colour map of matplotlib between two numbers."""

    colours: str
    low: float
    high: float
    label: str

    def pixels(self, values: Array) -> NDArray[np.uint8]:
        """Red, green, blue and opacity (..., 4) of numbers; NaN and infinity are transparent."""
        shares = (np.ma.masked_invalid(values) - self.low) / (self.high - self.low)
        return np.asarray(matplotlib.colormaps[self.colours](shares, bytes=True))

    def names(self, values: Sequence[float]) -> list[str]:
        """Colours of numbers as HTML codes."""
        packed = np.ascontiguousarray(self.pixels(np.array(values))).view(np.uint32).ravel()
        few, places = np.unique(
            packed, return_inverse=True
        )  # large arrays have only some hundred different colours
        names = ["#" + pixel.tobytes()[:3].hex() for pixel in few]
        return [names[place] for place in places.tolist()]

    @property
    def stops(self) -> list[tuple[float, str]]:
        """Positions [0, 1] and colours of a gradient."""
        return [
            (share, to_hex(matplotlib.colormaps[self.colours](share)))
            for share in np.linspace(0, 1, 12).tolist()
        ]

    @property
    def ticks(self) -> Sequence[Tick]:
        """Ticks of a colour bar."""
        return ticks(self.low, self.high)


@dataclass(frozen=True, eq=False)
class PlanePicture:
    """A picture of a rectangle, seen straight on.

    Attributes
    ----------
    title : str
        Also the text alternative of the picture.
    picture : str
        Its URL.
    width, height : float [m]
        Size of the rectangle.
    """

    title: str
    picture: str
    width: float
    height: float

    @property
    def _low(self) -> Array:
        """The lower left corner (2,) [m]; the origin is the rectangle's centre."""
        return np.array([-self.width, -self.height]) / 2

    @property
    def x_ticks(self) -> Sequence[Tick]:
        """Ticks to the right [m]."""
        return ticks(float(self._low[0]), float(self._low[0]) + self.width)

    @property
    def y_ticks(self) -> Sequence[Tick]:
        """Ticks upwards [m]."""
        return ticks(float(self._low[1]), float(self._low[1]) + self.height)


@dataclass(frozen=True, eq=False)
class HeatMap(PlanePicture):
    """A coloured map of a rectangle, whose picture is a data URL.

    Attributes
    ----------
    scale : Scale
    values : (rows, columns)
        Data of the map, rows from the top.
    outline : str
        Outline of a region of the map as a data URL; empty if there is none.
    facets : FacetPlaces or None
        Of the map of a mirror: their edges are drawn, and the rectangle is the one around them.
    extremes : (least, most) or None
        Of what is drawn; None for those of ``values``, whose pixels may lie beside them.
    """

    formats: ClassVar[tuple[str, ...]] = ("npz", "png")

    scale: ColourScale
    values: Array = field(repr=False)
    outline: str = ""
    facets: FacetPlaces | None = None
    extremes: tuple[float, float] | None = None

    @property
    def edges(self) -> list[list[list[float]]]:
        """Edges of facets: corners from 0 to 1, rightwards and upwards."""
        if self.facets is None:
            return []
        low, size = self.facets.box[0], np.array([self.width, self.height])
        return [np.round((edge - low) / size, 4).tolist() for edge in self.facets.edges()]

    @property
    def _low(self) -> Array:
        return super()._low if self.facets is None else np.asarray(self.facets.box[0])

    @property
    def beyond(self) -> tuple[float, float] | None:
        """The smallest and the largest value if any lies beyond the scale, otherwise None."""
        ends = float(np.nanmin(self.values)), float(np.nanmax(self.values))
        least, most = self.extremes or ends
        slack = 1e-6 * (self.scale.high - self.scale.low)
        return (
            (least, most)
            if least < self.scale.low - slack or most > self.scale.high + slack
            else None
        )

    @property
    def arrays(self) -> dict[str, NDArray[Any]]:
        """Values in the unit of the scale, and the size [m] of the map."""
        size_m = np.array([self.width, self.height])
        return {"values": self.values, "size_m": size_m, "unit": np.array(self.scale.label)}

    def drawn(self) -> bytes:
        """The map as PNG, with axes and a colour bar."""
        scale = self.scale
        size, bounds = (self.width, self.height), (scale.low, scale.high)
        return map_picture(
            self.values, size, self.title, scale.colours, bounds, scale.label, self.facets
        )


def _data_url(pixels: NDArray[np.uint8]) -> str:
    encoded = cv2.imencode(".png", pixels[..., [2, 1, 0, 3]])[1]
    return "data:image/png;base64," + base64.b64encode(encoded.tobytes()).decode()


def heat_map(title: str, values: Array, size: tuple[float, float], scale: ColourScale) -> HeatMap:
    """A map of ``values`` (rows from the top, columns).

    ``size`` is its width and height [m].
    """
    return HeatMap(title, _data_url(scale.pixels(values)), *size, scale, values)


def flux_scale(top: float, unit: str) -> ColourScale:
    """Scale of flux: dark at zero."""
    return ColourScale("inferno", 0.0, max(top, 1e-9), unit)


def difference_scale(bound: float, unit: str) -> ColourScale:
    """Scale of forecast minus photograph: white at zero, red if the forecast is brighter."""
    return ColourScale("RdBu_r", -bound, bound, unit)


def flux_map(
    title: str, flux: Array, size: tuple[float, float], unit: str, top: float | None = None
) -> HeatMap:
    """A flux map, dark at zero.

    ``top`` is the end of its scale, by default the peak.
    """
    return heat_map(title, flux, size, flux_scale(float(flux.max()) if top is None else top, unit))


def irradiance_map(
    title: str, flux: Array, size: tuple[float, float], top: float | None = None
) -> HeatMap:
    """A map of ``flux`` [W/m2] in kW/m2; ``top`` [W/m2] is the end of its scale."""
    return flux_map(title, flux / 1e3, size, "kW/m²", None if top is None else top / 1e3)


def outlined(drawn: HeatMap, mask: NDArray[np.bool_]) -> HeatMap:
    """A map with the edge of a region, if it is not empty; ``mask`` is (rows, columns)."""
    if not mask.any():
        return drawn
    fine = np.kron(mask, np.ones((8, 8), dtype=bool)).astype(np.uint8)
    edge = (fine - cv2.erode(fine, np.ones((5, 5), np.uint8), borderValue=0)).astype(bool)
    pixels = np.zeros((*fine.shape, 4), np.uint8)
    pixels[edge] = 0, 255, 255, 255
    return replace(drawn, outline=_data_url(pixels))


# Pixels of an overlay for each pixel of its map.
_FINE = 8

_WHITE, _BLACK = (255, 255, 255, 255), (0, 0, 0, 255)


def dotted(drawn: HeatMap, places: Array) -> HeatMap:
    """A map with dots at places (N, 2) [m], right and up of its middle; those beside it are not."""
    rows, columns = (_FINE * count for count in drawn.values.shape)
    pixels = np.zeros((rows, columns, 4), np.uint8)
    right = (places[:, 0] / drawn.width + 0.5) * columns
    down = (0.5 - places[:, 1] / drawn.height) * rows
    for radius, colour in ((4, _BLACK), (2, _WHITE)):
        for x, y in np.round([right, down]).astype(int).T.tolist():
            cv2.circle(pixels, (x, y), radius, colour, -1)
    return replace(drawn, outline=_data_url(pixels))


def difference_map(
    title: str, difference: Array, size: tuple[float, float], unit: str, bound: float
) -> HeatMap:
    """A map of differences, white at zero; its scale ends at -``bound`` and ``bound``."""
    return heat_map(title, difference, size, difference_scale(bound, unit))


def _mirror_map(title: str, control: Array, places: FacetPlaces, scale: ColourScale) -> HeatMap:
    """Control heights (F, 8, 8) [m] in mm on the facets of a mirror, seen from the front."""
    heights, (low, high) = mirror_heights(control), places.box
    width, height = (high - low).tolist()
    drawn = heat_map(title, places.image(heights), (width, height), scale)
    return replace(drawn, facets=places, extremes=(float(heights.min()), float(heights.max())))


def surface_map(title: str, z: Array, places: FacetPlaces, bound: float) -> HeatMap:
    """A surface of control heights (F, 8, 8) [m] in mm, red if higher.

    ``bound`` [mm] is the end of the scale on both sides.
    """
    return _mirror_map(title, z, places, ColourScale("RdBu_r", -bound, bound, "mm"))


def uncertainty_map(title: str, z_std: Array, places: FacetPlaces, top: float) -> HeatMap:
    """Standard deviations (F, 8, 8) [m] in mm.

    ``top`` [mm] is the end of the scale.
    """
    return _mirror_map(title, z_std, places, ColourScale("viridis_r", 0.0, top, "mm"))


@dataclass(frozen=True)
class Point:
    """A value in a history: its position from 0 to 1, rightwards and upwards, with its label."""

    x: float
    y: float
    label: str
    name: str


@dataclass(frozen=True)
class History:
    """Values in the order they came, as a line.

    ``ticks`` are those of the vertical axis. ``values`` are pairs of a name and a value.
    """

    formats: ClassVar[tuple[str, ...]] = ("csv", "png")

    title: str
    unit: str
    points: tuple[Point, ...]
    ticks: Sequence[Tick]
    values: Sequence[tuple[str, float]]

    @property
    def sheet(self) -> Sheet:
        """All values by name."""
        return ("name", f"{self.title} [{self.unit}]"), self.values

    def drawn(self) -> bytes:
        """The history as PNG."""
        names, numbers = zip(*self.values, strict=True)
        return series_picture(self.title, self.unit, {"": (names, numbers)})


def history(title: str, unit: str, named: Sequence[tuple[str, float]], digits: int) -> History:
    """Values with their names, evenly spaced, over an axis from zero."""
    top = max([value for _, value in named] + [1e-9]) * 1.1
    step = 1 / max(len(named) - 1, 1)
    points = tuple(
        Point(
            index * step if len(named) > 1 else 0.5, value / top, f"{value:.{digits}f} {unit}", name
        )
        for index, (name, value) in enumerate(named)
    )
    return History(title, unit, points, ticks(0.0, top, 4), named)
