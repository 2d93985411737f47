"""What becomes of each watt of mirrors' light, by the names of ``field.json``."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Discriminator, Field, Tag
from typing_extensions import TypedDict

from model.fleet import LOSSES, FleetFlux, Losses, field_losses
from service.base.fields import Irradiance


def _way_to_give(value: Any) -> str:
    return "(word)" if isinstance(value, str) else "(number)"


Sunlight = Annotated[
    Annotated[Irradiance, Tag("(number)")] | Annotated[Literal["clear_sky"], Tag("(word)")],
    Discriminator(_way_to_give),
    Field(
        description=(
            "Direct normal irradiance [W/m2], or `clear_sky` for that of a clear sky at the plant's"
            " altitude under this sun."
        )
    ),
]
"""The light of the sun, given or that of a clear sky."""


def clear_sky_dni(elevation_deg: float, altitude_m: float) -> float:
    """Direct normal irradiance [W/m2] of a clear sky.

    Source: Ineichen 2008, *A broadband simplified version of the Solis clear sky model*, as pvlib
    has it, with its default aerosol and water.
    """
    from pvlib import atmosphere, clearsky

    pressure = atmosphere.alt2pres(altitude_m)
    sky = clearsky.simplified_solis(np.array([elevation_deg]), pressure=pressure)
    return float(sky["dni"][0])


def dni_of(
    sunlight: float | Literal["clear_sky"], elevation_deg: float, altitude_m: float
) -> float:
    """The irradiance [W/m2] that is given, or that of a clear sky."""
    if sunlight == "clear_sky":
        return clear_sky_dni(elevation_deg, altitude_m)
    return sunlight


class ForecastLosses(TypedDict):
    """What becomes of the light on a heliostat, in watts.

    The factors are in the order of the light, and each is the share that is left. Neighbours and
    tower are not traced, so that shading and blocking are 1.
    """

    mirror_area_m2: Annotated[float, Field(description="Area of the facets [m2].")]
    incident_w: Annotated[float, Field(description="Direct normal irradiance times that area [W].")]
    cosine: Annotated[
        float,
        Field(
            description=(
                "Projection of the mirror towards the sun, less what the effects soiling and"
                " blocking take [1]."
            )
        ),
    ]
    shading: Annotated[float, Field(description="Share that is not shaded [1].")]
    blocking: Annotated[float, Field(description="Share that is not blocked [1].")]
    reflectance: Annotated[
        float, Field(description="Reflectance of mirrors and of the model's optics [1].")
    ]
    cleanliness: Annotated[float, Field(description="Share that soiling leaves; here 1 [1].")]
    attenuation: Annotated[float, Field(description="Share that the air leaves [1].")]
    intercept: Annotated[
        float, Field(description="Share that hits the whole target or receiver, mapped or not [1].")
    ]
    absorptance: Annotated[float, Field(description="Share that it absorbs [1].")]
    optical_efficiency: Annotated[float, Field(description="Product of the factors [1].")]
    intercepted_w: Annotated[float, Field(description="Power on the whole target or receiver [W].")]
    absorbed_w: Annotated[float, Field(description="Power that it absorbs [W].")]


class FieldWatts(ForecastLosses):
    """The light of a field, and its peak [W/m2]."""

    heliostats: int
    peak_w_m2: float


def light_watts(losses: Losses, dni_w_m2: float) -> ForecastLosses:
    """The light of mirrors with these losses, of one heliostat or of many."""
    incident = dni_w_m2 * losses.area
    return ForecastLosses(
        mirror_area_m2=losses.area,
        incident_w=incident,
        cosine=losses.cosine,
        shading=losses.shading,
        blocking=losses.blocking,
        reflectance=losses.reflectance,
        cleanliness=losses.cleanliness,
        attenuation=losses.attenuation,
        intercept=losses.intercept,
        absorptance=losses.absorptance,
        optical_efficiency=losses.efficiency,
        intercepted_w=incident * losses.intercepted,
        absorbed_w=incident * losses.efficiency,
    )


def field_watts(flux: FleetFlux, dni_w_m2: float) -> FieldWatts:
    """The light of heliostats together; at least one must have reached the receiver."""
    return {
        "heliostats": flux.heliostats,
        **light_watts(field_losses(flux.losses.values()), dni_w_m2),
        "peak_w_m2": float(flux.irradiance.max()),
    }


def heliostat_watts(losses: Mapping[str, Losses], dni_w_m2: float) -> dict[str, dict[str, float]]:
    """Factors, optical efficiency and intercepted power [W] of each heliostat by name."""
    return {
        name: {
            **{factor: getattr(one, factor) for factor in LOSSES},
            "optical_efficiency": one.efficiency,
            "intercepted_w": dni_w_m2 * one.area * one.intercepted,
        }
        for name, one in losses.items()
    }


@dataclass(frozen=True)
class LossStage:
    """A step of the light's way: its factor, what it takes and what is left [W].

    ``share`` is what is left of the light on the mirrors' area.
    """

    name: str
    factor: float | None
    lost_w: float | None
    left_w: float
    share: float


def loss_chain(watts: Mapping[str, Any]) -> list[LossStage]:
    """The chain of losses from the light on the mirrors' area to what is absorbed."""
    incident = watts["incident_w"]
    stages, left = [LossStage("on the mirrors' area", None, None, incident, 1.0)], incident
    for name in LOSSES:
        factor = watts[name]
        before, left = left, left * factor
        stages.append(LossStage(name, factor, before - left, left, left / incident))
    return stages
