"""What the library returns: surfaces, fluxes, photographs, comparisons and studies."""

from dataclasses import dataclass
from datetime import datetime
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
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


@dataclass(frozen=True, eq=False)
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
    flux: NDArray[np.float32] | None
    centered: NDArray[np.float32]


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
    forecast: NDArray[np.float32]
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
    effects: list[dict[str, Any]]
    accuracy_before: float
    accuracy_after: float
    report: dict[str, Any]
