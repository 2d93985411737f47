"""What the library returns: surfaces, fluxes, photographs, comparisons and studies."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any, Literal

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from numpy.typing import NDArray

from model.images import FLUX_WINDOW
from service.drawing.facets import FacetPlaces
from service.drawing.pictures import draw_map, mirror_heights

Array = NDArray[np.float64]


def new_axes(ax: Axes | None) -> Axes:
    """``ax``, or the axes of a new figure of pyplot."""
    from matplotlib import pyplot  # its import chooses a backend

    return pyplot.figure(layout="constrained").subplots() if ax is None else ax


@dataclass(frozen=True, eq=False, repr=False)
class Surface:
    """The mirror surface of a heliostat.

    Attributes
    ----------
    heliostat : str
    source : str
        "ideal", "measured", "network", "refined", or "given" for heights of the caller.
    z : (F, 8, 8) [m]
        Control heights of F facets, along x and along y, over the ideally canted facet.
    control_points : (F, I, J, 3) [m]
        Of the splines, in mirror coordinates: x right, y up, z out of the mirror.
    degree : int
        Of the splines.
    z_std : (F, 8, 8) [m] or None
        Standard deviations of the heights, if the surface was predicted.
    images : tuple of str
        Identifiers of the photographs that it was predicted from.
    misfit : float [1] or None
        Share of their flux that it leaves unexplained.
    warnings : tuple of str
        Reasons not to trust it, in sentences.
    """

    heliostat: str
    source: Literal["ideal", "measured", "network", "refined", "given"]
    z: Array
    control_points: Array
    degree: int = 3
    z_std: Array | None = None
    images: tuple[str, ...] = ()
    misfit: float | None = None
    warnings: tuple[str, ...] = ()

    def __repr__(self) -> str:
        parts = [self.heliostat, self.source, f"{len(self.z)} facets"]
        parts += [f"{len(self.images)} photographs"] if self.images else []
        parts += [f"{self.misfit:.1%} unexplained"] if self.misfit is not None else []
        parts += [f"{len(self.warnings)} warnings"] if self.warnings else []
        return f"Surface({', '.join(parts)})"

    def plot(self, bound_mm: float = 2.0, ax: Axes | None = None) -> Axes:
        """Draw the heights over the ideal facets [mm], seen from the front.

        Parameters
        ----------
        bound_mm : float [mm]
            End of the colour scale on both sides.
        ax : matplotlib.axes.Axes, optional
            By default those of a new figure.

        Returns
        -------
        matplotlib.axes.Axes
        """
        axes, places = new_axes(ax), FacetPlaces.of_control_points(self.control_points)
        (width, height), heights = np.ptp(places.box, axis=0).tolist(), mirror_heights(self.z)
        bounds, size = (-bound_mm, bound_mm), (width, height)
        draw_map(axes, places.image(heights), size, "RdBu_r", bounds, "height [mm]", places)
        axes.set_title(f"{self.heliostat}, {self.source}")
        return axes


@dataclass(frozen=True, eq=False, repr=False)
class Flux:
    """The flux of one heliostat on a plane, or on the unrolled map of a cylinder.

    Attributes
    ----------
    flux : (rows, columns) float32 [W/m2]
        Row 0 is at the top. Columns go to the right as seen from the lit side.
    size_m : (float, float) [m]
        Width and height of the map.
    peak_w_m2 : float [W/m2]
    power_w : float [W]
        On the whole map.
    center_of_mass_m : (2,) [m] or None
        Right and up of the plane's centre; None on a cylinder.
    camera_view : (rows, columns) float32 or None
        What the plant's camera would show of it; None on a cylinder.
    sun_deg : (float, float) [deg]
        Azimuth from north over east, and elevation.
    """

    flux: NDArray[np.float32]
    size_m: tuple[float, float]
    peak_w_m2: float
    power_w: float
    center_of_mass_m: Array | None
    camera_view: NDArray[np.float32] | None
    sun_deg: tuple[float, float]

    def __repr__(self) -> str:
        size, sun = "{:.3g} x {:.3g} m".format(*self.size_m), "{:.1f}, {:.1f}".format(*self.sun_deg)
        peak, power = f"{self.peak_w_m2 / 1e3:.3g} kW/m2", f"{self.power_w / 1e3:.3g} kW"
        return f"Flux({size}, peak {peak}, power {power}, sun {sun} deg)"

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draw the map [kW/m2] into ``ax``, by default of a new figure; return the axes."""
        axes = new_axes(ax)
        draw_map(axes, self.flux / 1e3, self.size_m, "inferno", (0.0, None), "flux [kW/m2]")
        return axes


@dataclass(frozen=True, eq=False)
class Photograph:
    """An accepted photograph of a target, and the flux that was measured on it.

    Attributes
    ----------
    identifier, target : str
    sun_deg : (float, float) [deg]
        Azimuth from north over east, and elevation.
    taken_at : datetime or None
    flux : (rows, columns) float32 or None
        On the whole target, with a sum of 100; None if only ``centered`` is known.
    centered : (64, 64) float32
        In 4 m about the centre of mass, with a sum of 100.
    """

    identifier: str
    target: str
    sun_deg: tuple[float, float]
    taken_at: datetime | None
    flux: NDArray[np.float32] | None = field(repr=False)
    centered: NDArray[np.float32] = field(repr=False)

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draw the flux about its centre into ``ax``, by default of a new figure; return the
        axes.
        """
        axes = new_axes(ax)
        draw_map(
            axes, self.centered, (FLUX_WINDOW,) * 2, "inferno", (0.0, None), "flux [% per pixel]"
        )
        axes.set_title("{}: sun {:.0f}°, {:.0f}°".format(self.identifier, *self.sun_deg))
        return axes


@dataclass(frozen=True, eq=False)
class Comparison:
    """The forecast of a photograph, compared with its measured flux.

    Attributes
    ----------
    photograph : Photograph
    forecast : (256, 256) float32
        What the camera would show of the forecast flux, on the whole target.
    accuracy : float [1]
        One minus the summed absolute difference in the window, over the measured sum.
    window_m : float [m]
        Side of the window about each centre of mass.
    is_held_out : bool
        Whether the surface was not predicted from this photograph.
    """

    photograph: Photograph
    forecast: NDArray[np.float32] = field(repr=False)
    accuracy: float
    window_m: float
    is_held_out: bool


@dataclass(frozen=True, eq=False)
class StudyResult:
    """What photographs show and the plant's model lacks.

    Attributes
    ----------
    verdict : str
        "effect", "none" or "unexplained".
    conclusion : str
        The verdict in a sentence.
    effects : list of dict
        Each with its ``name``, ``parameters`` with 95 % intervals, ``scope`` and gain.
    accuracy_before, accuracy_after : float [1]
        Mean over photographs that no fit has seen.
    report : dict
        All of it, as ``heliotwin study`` writes it.
    """

    verdict: Literal["effect", "none", "unexplained"]
    conclusion: str
    effects: list[dict[str, Any]] = field(repr=False)
    accuracy_before: float
    accuracy_after: float
    report: dict[str, Any] = field(repr=False)

    @property
    def parameters(self) -> pd.DataFrame:
        """The parameters of the effects as a table: value, and interval of 95 %."""
        rows = [
            (effect["name"], name, found["value"], *(found["ci95"] or (np.nan, np.nan)))
            for effect in self.effects
            for name, found in effect["parameters"].items()
        ]
        return pd.DataFrame(rows, columns=["effect", "parameter", "value", "low", "high"])


def to_frame(items: Iterable[Photograph | Comparison | Surface | Flux]) -> pd.DataFrame:
    """Results as a table of pandas, one row each, without their arrays.

    A comparison has the columns of its photograph, too.

    Examples
    --------
    >>> heliotwin.to_frame(plant.compare(surface)).groupby("is_held_out").accuracy.mean()
    """
    rows = (vars(getattr(one, "photograph", one)) | vars(one) for one in items)
    wide = (np.ndarray, Photograph)
    return pd.DataFrame([{k: v for k, v in r.items() if not isinstance(v, wide)} for r in rows])
