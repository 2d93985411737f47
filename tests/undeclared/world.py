"""How the world really is: everything that a measurement set may hold and that the model does not
know of.

Each disturbance is drawn at one of three strengths, 0 to 2, which change the forecast by some 2, 4
and 8 % where its bounds allow: a function gives the fields of `World` that it changes and, for
those of the catalogue (DESIGN.md, section 5), the parameters that a study ought to find.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Values = float | Array
Drawn = tuple[dict[str, Any], dict[str, Any]]
"""Fields of `World`, and the effect's parameters as JSON has them."""


@dataclass(frozen=True, eq=False)
class World:
    """Disturbances of sky, mount, mirror and camera; the defaults are the declared world, in which
    there are none.

    Those of mirrors are one value for all, or arrays (heliostat,), (heliostat, facet) or, for
    ``canting_mrad``, (heliostat, facet, 2); ``encoder_deg`` (heliostat, 2) is what axes stand at
    beyond what encoders say. ``gamma``, ``saturation`` and ``compression`` bend the mirror's light
    alone, ``law`` that of sheet and mirror together, on photographs. The last two blocks are in no
    catalogue; `UNSEEN` says what those of the last one are.
    """

    circumsolar_ratio: float = 0.02
    clock_minutes: float = 0.0
    tilt_deg: tuple[float, float] = (0.0, 0.0)
    pylon_mrad: float = 0.0
    encoder_deg: Values = 0.0
    first_axis_mrad: float = 0.0
    roughness_mrad: float = 0.0
    canting_mrad: Values = 0.0
    sag_mm: float = 0.0
    reflectivity: Values = 1.0
    hidden: Values = 0.0
    gamma: float = 1.0
    saturation: float = 1.0
    compression: float = 0.0
    blur_m: float = 0.0
    stray: tuple[float, float, float] = (0.0, 0.0, 0.0)
    registration: tuple[float, float, float, float] = (1.0, 1.0, 0.0, 0.0)
    ghost: tuple[float, float, float] = (0.0, 0.0, 0.0)

    second_axis_mrad: float = 0.0
    curvature: Values = 0.0
    twist_mrad_m: float = 0.0
    clouded: float = 0.0
    barrel: float = 0.0
    law: float = 1.0

    row_focus: float = 0.0
    gloss: float = 0.0
    flattened: float = 0.0
    gap_m: float = 0.0
    rolling_m: float = 0.0
    hot: tuple[tuple[float, float], ...] = ()
    dew: float = 0.0
    mast: tuple[float, float] = (0.0, 0.0)
    seal_mrad: float = 0.0
    side_blur_m: float = 0.0


def _sign(rng: np.random.Generator) -> float:
    return float(rng.choice([-1.0, 1.0]))


def _by_name(names: Sequence[str], values: Array) -> dict[str, Any]:
    return dict(zip(names, values.tolist(), strict=True))


def sun_shape(level: int, names: Sequence[str], rng: np.random.Generator) -> Drawn:
    ratio = (0.055, 0.09, 0.18)[level]
    return {"circumsolar_ratio": ratio}, {"circumsolar_ratio": ratio}


def slope_error(level: int, names: Sequence[str], rng: np.random.Generator) -> Drawn:
    sigma = (0.44, 0.64, 0.95)[level]
    return {"roughness_mrad": sigma}, {"sigma_mrad": sigma}


def tracking_jitter(level: int, names: Sequence[str], rng: np.random.Generator) -> Drawn:
    sigma = (0.6, 0.85, 1.25)[level]
    return {"first_axis_mrad": sigma}, {"sigma_mrad": sigma}


def facet_canting(level: int, names: Sequence[str], rng: np.random.Generator) -> Drawn:
    """Without the tilt of the whole mirror, which the alignment takes back."""
    tilt = (0.19, 0.38, 0.76)[level] * rng.standard_normal((len(names), 4, 2))
    tilt = np.round(np.clip(tilt - tilt.mean(axis=1, keepdims=True), -5, 5), 4)
    return {"canting_mrad": tilt}, {
        axis: _by_name(names, tilt[..., i]) for i, axis in enumerate(("x_mrad", "y_mrad"))
    }


def gravity_bending(level: int, names: Sequence[str], rng: np.random.Generator) -> Drawn:
    sag = _sign(rng) * (1.2, 2.4, 4.8)[level]
    return {"sag_mm": sag}, {"amplitude_mm": sag}


def axis_tilt(level: int, names: Sequence[str], rng: np.random.Generator) -> Drawn:
    size, turn = (1.0, 2.0, 3.0)[level], rng.uniform(0, 2 * np.pi)
    north, up = round(size * np.cos(turn), 3), round(size * np.sin(turn), 3)
    return {"tilt_deg": (north, up)}, {"north_deg": north, "up_deg": up}


def pylon_bending(level: int, names: Sequence[str], rng: np.random.Generator) -> Drawn:
    lean = _sign(rng) * (4.0, 8.0, 16.0)[level]
    return {"pylon_mrad": lean}, {"amplitude_mrad": lean}


def encoder_offset(level: int, names: Sequence[str], rng: np.random.Generator) -> Drawn:
    off = np.round((0.15, 0.3, 0.6)[level] * rng.standard_normal((len(names), 2)), 4)
    return {"encoder_deg": off}, {
        f"{axis}_deg": _by_name(names, off[:, i]) for i, axis in enumerate(("first", "second"))
    }


def sun_position(level: int, names: Sequence[str], rng: np.random.Generator) -> Drawn:
    minutes = _sign(rng) * (30.0, 60.0, 90.0)[level]
    return {"clock_minutes": minutes}, {"minutes": minutes}


def soiling(level: int, names: Sequence[str], rng: np.random.Generator) -> Drawn:
    """Every heliostat has one clean facet, to which the others are compared."""
    clean = 1 - (0.45, 0.75, 0.95)[level] * rng.random((len(names), 4))
    clean[np.arange(len(names)), rng.integers(4, size=len(names))] = 1.0
    clean = np.round(clean, 4)
    return {"reflectivity": clean}, {"reflectivity_ratio": _by_name(names, clean)}


def blocking(level: int, names: Sequence[str], rng: np.random.Generator) -> Drawn:
    hidden = np.round((0.04, 0.08, 0.16)[level] * rng.uniform(0.5, 1, len(names)), 4)
    return {"hidden": hidden}, {"lower_fraction": _by_name(names, hidden)}


def camera_response(level: int, names: Sequence[str], rng: np.random.Generator) -> Drawn:
    gamma = round((1.035, 1.07, 1.14)[level] ** _sign(rng), 4)
    saturation = (1.0, 0.97, 0.9)[level]
    return {"gamma": gamma, "saturation": saturation}, {"gamma": gamma, "saturation": saturation}


def camera_shoulder(level: int, names: Sequence[str], rng: np.random.Generator) -> Drawn:
    compression = (0.12, 0.25, 0.5)[level]
    return {"compression": compression}, {"compression": compression}


def camera_blur(level: int, names: Sequence[str], rng: np.random.Generator) -> Drawn:
    sigma = (0.09, 0.13, 0.2)[level]
    return {"blur_m": sigma}, {"sigma_m": sigma}


def background(level: int, names: Sequence[str], rng: np.random.Generator) -> Drawn:
    """Never darker than black on a target of 7 m."""
    lift = (0.0015, 0.003, 0.006)[level]
    x, y = np.round(lift * rng.uniform(-0.5, 0.5, 2) / 3.5, 6).tolist()
    return {"stray": (lift, x, y)}, {"level": lift, "gradient_x": x, "gradient_y": y}


def target_registration(level: int, names: Sequence[str], rng: np.random.Generator) -> Drawn:
    size = (0.011, 0.024, 0.05)[level]
    scale_x, scale_y = np.round(
        1 + size * rng.uniform(0.5, 1.5, 2) * rng.choice([-1, 1], 2), 4
    ).tolist()
    shear, turn = np.round(size * rng.uniform(-1, 1, 2) * [1, 90], 4).tolist()
    found = {"scale_x": scale_x, "scale_y": scale_y, "shear": shear, "rotation_deg": turn}
    return {"registration": tuple(found.values())}, found


def camera_ghost(level: int, names: Sequence[str], rng: np.random.Generator) -> Drawn:
    share, size, turn = (
        (0.016, 0.035, 0.08)[level],
        rng.uniform(0.6, 1.2),
        rng.uniform(0, 2 * np.pi),
    )
    right, up = round(size * np.cos(turn), 3), round(size * np.sin(turn), 3)
    return {"ghost": (share, right, up)}, {"share": share, "right_m": right, "up_m": up}


def second_axis_wobble(level: int, names: Sequence[str], rng: np.random.Generator) -> Drawn:
    return {"second_axis_mrad": (0.8, 1.1, 1.7)[level]}, {}


def facet_focus(level: int, names: Sequence[str], rng: np.random.Generator) -> Drawn:
    """One facet of each heliostat is bent [1/m]."""
    bent = np.zeros((len(names), 4))
    signs = rng.choice([-1.0, 1.0], len(names))
    bent[np.arange(len(names)), rng.integers(4, size=len(names))] = (0.0006, 0.0012, 0.0024)[
        level
    ] * signs
    return {"curvature": bent}, {}


def thermal_twist(level: int, names: Sequence[str], rng: np.random.Generator) -> Drawn:
    """Mirrors twist with a temperature that nobody recorded [mrad of slope a metre, per standard
    deviation].
    """
    return {"twist_mrad_m": (0.2, 0.35, 0.6)[level]}, {}


def clouded_sun(level: int, names: Sequence[str], rng: np.random.Generator) -> Drawn:
    """The edge of a cloud crosses the sun and takes a share of the light of one half."""
    return {"clouded": (0.25, 0.45, 0.8)[level]}, {}


def barrel_distortion(level: int, names: Sequence[str], rng: np.random.Generator) -> Drawn:
    return {"barrel": (0.1, 0.2, 0.35)[level]}, {}


def row_focus(level: int, names: Sequence[str], rng: np.random.Generator) -> Drawn:
    """The upper row of facets bends [1/m] with a recorded temperature, per standard deviation."""
    return {"row_focus": _sign(rng) * (0.0005, 0.001, 0.002)[level]}, {}


def glossy_target(level: int, names: Sequence[str], rng: np.random.Generator) -> Drawn:
    """The target is not Lambertian: it sends more light where a mirror in it would."""
    return {"gloss": (2.0, 5.0, 12.0)[level]}, {}


def flattened_sun(level: int, names: Sequence[str], rng: np.random.Generator) -> Drawn:
    """Air flattens a low sun by a share, which falls with its elevation."""
    return {"flattened": (0.3, 0.5, 0.8)[level]}, {}


def facet_gap(level: int, names: Sequence[str], rng: np.random.Generator) -> Drawn:
    """Facets are mounted farther apart than planned."""
    return {"gap_m": (0.06, 0.12, 0.24)[level]}, {}


def rolling_shutter(level: int, names: Sequence[str], rng: np.random.Generator) -> Drawn:
    """Rows are read one after the other, while the camera vibrates."""
    return {"rolling_m": (0.04, 0.08, 0.16)[level]}, {}


def hot_pixels(level: int, names: Sequence[str], rng: np.random.Generator) -> Drawn:
    """Places on the sensor, right and up in halves of the image, that are always bright."""
    places = rng.uniform(-0.5, 0.5, ((40, 80, 160)[level], 2))
    return {"hot": tuple(map(tuple, places.tolist()))}, {}


def dew(level: int, names: Sequence[str], rng: np.random.Generator) -> Drawn:
    """Dew on the lower third of each facet takes a share of its light."""
    return {"dew": (0.2, 0.4, 0.7)[level]}, {}


def mast_shadow(level: int, names: Sequence[str], rng: np.random.Generator) -> Drawn:
    """The camera's mast shades a strip of the targets: place [m], and share of the light."""
    return {"mast": (rng.uniform(-0.7, 0.7), (0.1, 0.2, 0.4)[level])}, {}


def swollen_seal(level: int, names: Sequence[str], rng: np.random.Generator) -> Drawn:
    """The seal of facets swells and bends their edges."""
    return {"seal_mrad": (0.5, 1.0, 2.0)[level]}, {}


def side_blur(level: int, names: Sequence[str], rng: np.random.Generator) -> Drawn:
    """A lens out of focus at its right side."""
    return {"side_blur_m": (0.2, 0.3, 0.45)[level]}, {}


def slight_tilt(level: int, names: Sequence[str], rng: np.random.Generator) -> Drawn:
    """Of a size that is visible by motor positions, but not by shapes, as in the next function."""
    size, turn = (0.1, 0.2, 0.4)[level], rng.uniform(0, 2 * np.pi)
    north, up = round(size * np.cos(turn), 4), round(size * np.sin(turn), 4)
    return {"tilt_deg": (north, up)}, {"north_deg": north, "up_deg": up}


def slow_clock(level: int, names: Sequence[str], rng: np.random.Generator) -> Drawn:
    minutes = _sign(rng) * (1.0, 2.0, 4.0)[level]
    return {"clock_minutes": minutes}, {"minutes": minutes}


Draw = Callable[[int, Sequence[str], np.random.Generator], Drawn]

CATALOGUE: dict[str, Draw] = {
    draw.__name__: draw
    for draw in (
        sun_shape,
        slope_error,
        tracking_jitter,
        facet_canting,
        gravity_bending,
        axis_tilt,
        pylon_bending,
        encoder_offset,
        sun_position,
        soiling,
        blocking,
        camera_response,
        camera_shoulder,
        camera_blur,
        background,
        target_registration,
        camera_ghost,
    )
}

OUTSIDE: dict[str, Draw] = {
    draw.__name__: draw
    for draw in (second_axis_wobble, facet_focus, thermal_twist, clouded_sun, barrel_distortion)
}


UNSEEN: dict[str, Draw] = {
    draw.__name__: draw
    for draw in (
        row_focus,
        glossy_target,
        flattened_sun,
        facet_gap,
        rolling_shutter,
        hot_pixels,
        dew,
        mast_shadow,
        swollen_seal,
        side_blur,
    )
}
"""Outside the catalogue, too; no threshold of the study was chosen by them."""


LIVES_IN = {
    "second_axis_wobble": "angle",
    "facet_focus": "mirror",
    "thermal_twist": "mirror",
    "clouded_sun": "angle",
    "barrel_distortion": "geometry",
    "row_focus": "mirror",
    "glossy_target": "target",
    "flattened_sun": "angle",
    "facet_gap": "mirror",
    "rolling_shutter": "geometry",
    "hot_pixels": "added_light",
    "dew": "mirror",
    "mast_shadow": "target",
    "swollen_seal": "mirror",
    "side_blur": "camera",
}
"""Where those outside the catalogue act."""


MOVING: dict[str, tuple[str, Draw]] = {
    "slight_tilt": ("axis_tilt", slight_tilt),
    "slow_clock": ("sun_position", slow_clock),
    "pylon_bending": ("pylon_bending", pylon_bending),
    "encoder_offset": ("encoder_offset", encoder_offset),
}
"""Cases that are visible by motor positions, each with its effect of the catalogue."""


def disturb(
    case: str, level: int, names: Sequence[str], rng: np.random.Generator
) -> tuple[World, list[dict[str, Any]]]:
    """The world of a case, ``clean`` or disturbances joined by ``+``, and its effects of the
    catalogue as JSON.
    """
    fields: dict[str, Any] = {}
    truth = []
    for name in [] if case == "clean" else case.split("+"):
        effect, draw = MOVING.get(name) or (name, {**CATALOGUE, **OUTSIDE, **UNSEEN}[name])
        changed, parameters = draw(level, names, rng)
        fields |= changed
        if effect in CATALOGUE:
            truth.append({"name": effect, "parameters": parameters})
    return World(**fields), truth
