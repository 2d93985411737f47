"""Attenuation of light between mirror and receiver, from the visibility of the air."""

from model.errors import InvalidInputError
from model.tracing.scene import CLEAR_DAY

HAZY_DAY = (0.01293, 0.2748, -0.03394, 0.0)
"""Attenuation of a hazy day, 5 km visibility; source as of `model.tracing.scene.CLEAR_DAY`."""

CLEAR_KM, HAZY_KM = 23.0, 5.0
"""Visibilities [km] of `CLEAR_DAY` and `HAZY_DAY`."""

MAX_KM = 300.0
"""Largest visibility [km]: that of air without aerosols."""


def attenuation_of_visibility(visibility_km: float) -> tuple[float, ...]:
    """Lost share of light as a polynomial in the slant range [km], for a ``visibility_km`` [km].

    Those of Vittitoe and Biggs at 5 and 23 km. At others each coefficient is linear in the
    extinction coefficient, 3.912 / visibility: the part of the loss that is due to aerosols is
    proportional to it, the part that is due to the molecules of the air is constant.

    Raises
    ------
    InvalidInputError
        Below 5 km, where a tower plant does not operate and no polynomial is published, or above
        `MAX_KM`.

    Source: Vittitoe and Biggs (1978), as in DELSOL3, SAND86-8018, eqs. 2.2-3; Koschmieder,
    *Theorie der horizontalen Sichtweite*, Beiträge zur Physik der freien Atmosphäre 12 (1924).
    """
    if not HAZY_KM <= visibility_km <= MAX_KM:
        raise InvalidInputError(
            f"visibility_km must lie in [{HAZY_KM:g}, {MAX_KM:g}], got {visibility_km:g}; for other"
            " air give attenuation, the polynomial in the slant range [km]"
        )
    share = (1 / visibility_km - 1 / CLEAR_KM) / (1 / HAZY_KM - 1 / CLEAR_KM)
    return tuple(
        clear + share * (hazy - clear) for clear, hazy in zip(CLEAR_DAY, HAZY_DAY, strict=True)
    )
