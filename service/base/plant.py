"""The plant's receivers, tower and other facts, as requests, the store and exports have them."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Discriminator, Field, Tag, model_validator

from model.errors import InvalidInputError
from model.plant import (
    MIN_OPENING_DEG,
    Cylinder,
    Receiver,
    TargetPlane,
    Tower,
    require_cylinder_shape,
)
from model.receivers import Cavity, Panels
from service.base.fields import Direction, Extent, JsonObject, Model, Number, Plane, Position

AnyReceiver = Cylinder | TargetPlane | Panels | Cavity
"""Receivers that can be stored."""

NAMES_WITH_UNITS = {
    name: f"{name}_m" for name in ("center", "width", "height", "radius", "aperture")
}
"""Fields as ``plant.yaml`` and the audit trail name them, where the unit is missing."""

MAX_PANELS = 64
"""Most panels of a receiver, and most corners of an aperture."""

KIND = Field(description="Its kind.")
ABSORPTANCE = Field(default=1.0, gt=0, le=1, description="Share of the light that it absorbs [1].")
_PANELS = Field(
    min_length=1,
    max_length=MAX_PANELS,
    description="Rectangles of one height, from left to right as seen by the light.",
)


class PlaneReceiverIn(Plane):
    """A flat receiver, such as a billboard."""

    kind: Literal["plane"] = KIND
    absorptance: Number = ABSORPTANCE


class _ReceiverPart(Model):
    """What receivers other than planes have in common."""

    absorptance: Number = ABSORPTANCE

    def named(self, name: str) -> AnyReceiver:
        """Convert to the model's receiver with this name, which answers have as a field."""
        return receiver_from_json(name, self.model_dump(exclude={"name"}))


class CylinderIn(_ReceiverPart):
    """A cylinder or a part of one, lit from outside; the default kind."""

    kind: Literal["cylinder"] = Field(default="cylinder", description="Its kind.")
    center: Position = Field(
        description="The middle of the lit surface: east, north, up of the tower base [m]."
    )
    normal: Direction = Field(
        description="Normal there, away from the axis, east-north-up; of any length."
    )
    up: Direction = Field(
        default=(0.0, 0.0, 1.0), description="Along the axis, upwards in the map."
    )
    radius: Annotated[Number, Field(ge=0.01, lt=1e3)] = Field(description="[m]")
    height: Extent = Field(description="Along the axis [m].")
    opening_deg: Number = Field(
        default=360.0,
        ge=MIN_OPENING_DEG,
        le=360,
        description="Angle of the lit surface about its middle [deg].",
    )

    @model_validator(mode="after")
    def _shape(self) -> Self:
        require_cylinder_shape(self.radius, self.height, self.opening_deg)
        return self


class _PanelledIn(_ReceiverPart):
    """Panels of one height."""

    panels: list[Plane] = _PANELS

    @model_validator(mode="after")
    def _one_height(self) -> Self:
        self.named("as given")
        return self


class PanelsIn(_PanelledIn):
    """Panels side by side, lit from outside."""

    kind: Literal["panels"] = KIND


class CavityIn(_PanelledIn):
    """Panels behind a polygonal opening."""

    kind: Literal["cavity"] = KIND
    aperture: list[Position] = Field(
        min_length=3,
        max_length=MAX_PANELS,
        description="Corners of the opening in one plane, counter-clockwise seen from outside [m].",
    )


def _kind_of(receiver: Any) -> str:
    """The tag of a receiver's kind; an unknown one is refused."""
    if isinstance(receiver, Mapping):
        return f"({receiver.get('kind', 'cylinder')})"
    return f"({getattr(receiver, 'kind', 'cylinder')})"


ReceiverIn = Annotated[
    Annotated[PlaneReceiverIn, Tag("(plane)")]
    | Annotated[CylinderIn, Tag("(cylinder)")]
    | Annotated[PanelsIn, Tag("(panels)")]
    | Annotated[CavityIn, Tag("(cavity)")],
    Discriminator(
        _kind_of,
        custom_error_type="receiver_kind",
        custom_error_message=(
            "must have a known `kind`: plane, cylinder (the default), panels or cavity"
        ),
    ),
]
"""A receiver of any kind."""


# --- to and from the model
# --------------------------------------------------------------------------------------------------

_MODELS: Mapping[str, type[AnyReceiver]] = {
    "plane": TargetPlane,
    "cylinder": Cylinder,
    "panels": Panels,
    "cavity": Cavity,
}
"""The model's receiver by kind; its attributes have the names of the document's fields."""

_SCHEMAS: Mapping[str, type[Model]] = {
    "plane": PlaneReceiverIn,
    "cylinder": CylinderIn,
    "panels": PanelsIn,
    "cavity": CavityIn,
}


def receiver_from_json(name: str, document: JsonObject) -> AnyReceiver:
    """The model's receiver of a document that was validated when it was stored."""
    values = {key: value for key, value in document.items() if key != "kind"}
    if "panels" in values:
        absorptance = values["absorptance"]
        values["panels"] = tuple(
            TargetPlane(f"{name}-{number}", **panel, absorptance=absorptance)
            for number, panel in enumerate(values["panels"], start=1)
        )
    return _MODELS[document["kind"]](name, **values)


def receiver_to_json(receiver: Receiver) -> JsonObject:
    """The document of a receiver, with all its fields.

    Raises
    ------
    InvalidInputError
        If its kind cannot be stored.
    """
    kind = next((kind for kind, made in _MODELS.items() if type(receiver) is made), None)
    if kind is None:
        raise InvalidInputError(
            f"receiver {receiver.name}: {type(receiver).__name__} is none of"
            f" {', '.join(_MODELS)}, which can be stored"
        )
    return {"kind": kind} | _values(_SCHEMAS[kind], receiver)


def rectangle(plane: TargetPlane) -> JsonObject:
    """Centre, directions and size of a plane, as `Plane` has them."""
    return _values(Plane, plane)


def _values(schema: type[Model], receiver: Receiver) -> JsonObject:
    values = {name: getattr(receiver, name) for name in schema.model_fields if name != "kind"}
    return {
        name: [rectangle(panel) for panel in value] if name == "panels" else _json(value)
        for name, value in values.items()
    }


def _json(value: ArrayLike) -> Any:
    return np.asarray(value, dtype=np.float64).tolist()


class TowerSize(Model):
    """The tower: an upright cylinder on the tower base, which casts a shadow."""

    radius_m: Number = Field(gt=0, lt=1e3, description="[m]")
    height_m: Number = Field(gt=0, lt=1e4, description="[m]")

    def tower(self) -> Tower:
        """As the model has it."""
        return Tower(self.radius_m, self.height_m)


@dataclass(frozen=True)
class PlantFacts:
    """Facts of a plant; each may be None.

    Attributes
    ----------
    tower : Tower or None
        It casts a shadow.
    time_zone : str or None
        Name in the IANA time zone database.
    heliostat_types : dict or None
        Of ``plant.yaml``: its ``types``, and the text of the ``files`` that they name.
    """

    tower: Tower | None = None
    time_zone: str | None = None
    heliostat_types: JsonObject | None = None

    def columns(self) -> dict[str, object]:
        """The facts by name, in the form of the store."""
        tower = self.tower and {"radius_m": self.tower.radius, "height_m": self.tower.height}
        return {**vars(self), "tower": tower}


NO_FACTS = PlantFacts()
"""Nothing is known."""
