"""A heliostat in the terms of ``plant.yaml``: its type, and the foot of its pylon."""

from collections.abc import Mapping

from pydantic import Field

from model.errors import InvalidInputError
from service.base.fields import JsonObject
from service.base.plant import AnyReceiver
from service.sources.heliostat_document import heliostat_to_json
from service.sources.plant_file import place_heliostat
from service.sources.plant_schema import (
    CantingChoice,
    FacetsEntry,
    HeliostatEntry,
    HeliostatPlace,
    HeliostatTypeEntry,
    TypeChoice,
    nearest,
)
from service.sources.plant_tables import PlacedHeliostat
from service.sources.plant_types import type_of_entry


class HeliostatOfType(HeliostatPlace):
    """A heliostat of any type, as of ``plant.yaml``."""

    type: TypeChoice = Field(
        description="Name of a heliostat type of the imported plant.yaml, or a type written out."
    )
    facets: FacetsEntry | None = Field(None, description="In place of the type's facets.")
    canting: CantingChoice | None = Field(None, description="In place of the type's canting.")


def document_of(
    name: str, given: HeliostatOfType, stored: JsonObject | None, goals: Mapping[str, AnyReceiver]
) -> JsonObject:
    """The document of a heliostat, as an import of the same ``plant.yaml`` makes it.

    ``stored`` are the plant's heliostat types (`service.base.plant.PlantFacts`). ``goals``
    are its receivers, then its targets.

    Raises
    ------
    InvalidInputError
        It names the field: a type or receiver that is not known, or what the model refuses.
    """
    known = stored or {"types": {}, "files": {}}
    own = {key: getattr(given, key) for key in ("facets", "canting") if getattr(given, key)}
    entry = _entry(given.type, known["types"]).model_copy(update=own)
    label = given.type if isinstance(given.type, str) and not own else ""
    place = {key: getattr(given, key) for key in HeliostatPlace.model_fields}
    # A mirror that differs from its type is of none.
    named = {"name": name, "type": label, "receiver": _goal(given.receiver, goals)}
    placed = HeliostatEntry.model_construct(**place | named)
    heliostat = place_heliostat(
        PlacedHeliostat("east_m, north_m, up_m", placed),
        type_of_entry(label or name, entry, known["files"]),
        goals[str(placed.receiver)],
    )
    return heliostat_to_json(heliostat, placed)


def _entry(chosen: str | HeliostatTypeEntry, types: JsonObject) -> HeliostatTypeEntry:
    if isinstance(chosen, HeliostatTypeEntry):
        return chosen
    if chosen not in types:
        remedy = nearest(chosen, list(types)) if types else "it has none; write the type out"
        raise InvalidInputError(f"type: {chosen!r} is no heliostat type of the plant; {remedy}")
    return HeliostatTypeEntry.model_validate(types[chosen])


def _goal(chosen: str | None, goals: Mapping[str, AnyReceiver]) -> str:
    if not goals:
        raise InvalidInputError(
            "receiver: the plant has neither receivers nor targets; PUT one to /v1/receivers/NAME"
        )
    name = chosen or next(iter(goals))
    if name not in goals:
        raise InvalidInputError(
            f"receiver: {name!r} is no receiver or target; {nearest(name, list(goals))}"
        )
    return name
