"""Receivers of every kind, as requests, the store and exports have them.

A document has the ``kind`` and the fields of one of the classes here, in REST's names.
"""

from collections.abc import Callable, Mapping
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Discriminator, Field, Tag, TypeAdapter, model_validator

from model.errors import InvalidInputError
from model.plant import MIN_OPENING_DEG, Cylinder, Receiver, TargetPlane, require_cylinder_shape
from model.receivers import Cavity, Panels
from service.base.fields import Direction, Extent, JsonObject, Model, Number, Plane, Position

AnyReceiver = Cylinder | TargetPlane | Panels | Cavity
"""Receivers that can be stored."""

RECEIVER_KINDS = ("plane", "cylinder", "panels", "cavity")
"""Kinds of `AnyReceiver`."""

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

    def named(self, name: str) -> TargetPlane:
        """Convert to the model's plane with this name."""
        return _plane(name, self.model_dump(), self.absorptance)


class _ReceiverPart(Model):
    """What receivers other than planes have in common."""

    absorptance: Number = ABSORPTANCE

    def named(self, name: str) -> AnyReceiver:
        """Convert to the model's receiver with this name."""
        return receiver_from_json(name, self.model_dump())


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

RECEIVER: TypeAdapter[PlaneReceiverIn | CylinderIn | PanelsIn | CavityIn] = TypeAdapter(ReceiverIn)
"""Validates the document of a receiver."""


# --- to and from the model
# --------------------------------------------------------------------------------------------------


def _plane(name: str, document: JsonObject, absorptance: float = 1.0) -> TargetPlane:
    center, normal, up = (np.array(document[key]) for key in ("center", "normal", "up"))
    return TargetPlane(name, center, normal, up, document["width"], document["height"], absorptance)


def _cylinder(name: str, document: JsonObject) -> Cylinder:
    center, normal, up = (np.array(document[key]) for key in ("center", "normal", "up"))
    sizes = (document[key] for key in ("radius", "height", "opening_deg", "absorptance"))
    return Cylinder(name, center, normal, up, *sizes)


def _several(name: str, document: JsonObject) -> tuple[TargetPlane, ...]:
    return tuple(
        _plane(f"{name}-{number}", panel, document["absorptance"])
        for number, panel in enumerate(document["panels"], start=1)
    )


def _panels(name: str, document: JsonObject) -> Panels:
    return Panels(name, _several(name, document), document["absorptance"])


def _cavity(name: str, document: JsonObject) -> Cavity:
    aperture = np.array(document["aperture"])
    return Cavity(name, _several(name, document), document["absorptance"], aperture=aperture)


_MAKERS: Mapping[str, Callable[[str, JsonObject], AnyReceiver]] = {
    "plane": lambda name, document: _plane(name, document, document["absorptance"]),
    "cylinder": _cylinder,
    "panels": _panels,
    "cavity": _cavity,
}


def receiver_from_json(name: str, document: JsonObject) -> AnyReceiver:
    """The model's receiver of a document that was validated when it was stored."""
    return _MAKERS[document["kind"]](name, document)


def receiver_to_json(receiver: Receiver) -> JsonObject:
    """The document of a receiver, with all its fields.

    Raises
    ------
    InvalidInputError
        If its kind cannot be stored.
    """
    given = {"absorptance": float(receiver.absorptance)}
    if isinstance(receiver, TargetPlane):
        return {"kind": "plane", **_rectangle(receiver), **given}
    if isinstance(receiver, Cylinder):
        sizes = {key: float(getattr(receiver, key)) for key in ("radius", "height", "opening_deg")}
        return {"kind": "cylinder", **_frame(receiver), **sizes, **given}
    if isinstance(receiver, Panels):
        return {"kind": "panels", "panels": [*map(_rectangle, receiver.panels)], **given}
    if isinstance(receiver, Cavity):
        opening = {"aperture": receiver.aperture.tolist()}
        return {"kind": "cavity", **opening, "panels": [*map(_rectangle, receiver.panels)], **given}
    raise InvalidInputError(
        f"receiver {receiver.name}: {type(receiver).__name__} is none of"
        f" {', '.join(RECEIVER_KINDS)}, which can be stored"
    )


def _frame(receiver: Receiver) -> JsonObject:
    return {key: getattr(receiver, key).tolist() for key in ("center", "normal", "up")}


def _rectangle(plane: TargetPlane) -> JsonObject:
    return {**_frame(plane), "width": float(plane.width), "height": float(plane.height)}
