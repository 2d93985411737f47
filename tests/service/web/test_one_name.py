"""One name, unit and type for each quantity, over the whole OpenAPI document."""

import re
from collections.abc import Iterator
from typing import Any

import pytest
from fastapi.testclient import TestClient

PAINT = {
    "FacetDocument",
    "FacetProperties",
    "HeliostatProperties",
    "KinematicsProperties",
    "PowerPlantProperties",
    "TowerMeasurements",
    "RotaryDriveDocument",
    "Spindle",
}
"""Schemas with the names of PAINT's documents, which stay."""

FORMER = {
    "age",
    "azimuth",
    "begin",
    "deviation",
    "elevation",
    "end",
    "focal_spot",
    "helios_spot",
    "made_at",
    "made_by",
    "number",
    "pointing",
    "sun_at",
    "sun_azimuth",
    "sun_elevation",
    "sun_span",
    "taken_from",
    "taken_to",
    "target_name",
    "time",
    "uncertainty",
    "window",
}
"""Names that a quantity had beside its present one."""

UNIT = re.compile(r"(^|_)(m|mm|m2|m_s|mrad|rad|deg|s|h|minutes|days|w|w_m2|c|px|bits|steps|wgs84)$")
"""How the name of a physical quantity ends."""

WITHOUT_UNIT = {
    # Shares of 1 and other ratios.
    "accuracy",
    "accuracy_after",
    "accuracy_before",
    "accuracy_mean",
    "accuracy_median",
    "after",
    "attenuation",
    "before",
    "blocking",
    "cleanliness",
    "cosine",
    "explained_share",
    "gain_share",
    "gear",
    "intercept",
    "mahalanobis_distance",
    "mean",
    "misfit",
    "noise_floor",
    "optical_efficiency",
    "per_image",
    "progress",
    "reference_sine",
    "reflectance",
    "shading",
    "score",
    "unexplained_share",
    # Intervals of the value beside them, whose unit its name or the field above has.
    "ci90",
    "ci95",
    "median",
    # Values of an effect's parameter, whose unit is the field beside it (DESIGN.md, section 7).
    "by_day",
    "limits",
    "value",
    # Of cameras: matrices, and coefficients of a lens.
    "distortion",
    "homography",
    "rotation",
    # Directions, a rotation of the mirror, and corners by the sides of their facet.
    "first_axis",
    "normal",
    "outline",
    "second_axis",
    "up",
    "zero_attitude",
    # Steps of drives.
    "motor_position",
    # Planes and receivers [m], and corners [px] or in WGS84.
    "absorptance",
    "aperture",
    "center",
    "corners",
    "height",
    "lower_left",
    "lower_right",
    "radius",
    "upper_left",
    "upper_right",
    "width",
    # Maps, in the unit that is described, and limits of the metric that is named beside them.
    "centered",
    "flux",
    "high",
    "low",
}

TIME = re.compile(r"^(at|not_before|since|until|valid_from|\w+_(at|since))$")


@pytest.fixture(scope="module")
def document(refusing: TestClient) -> dict[str, Any]:
    """The OpenAPI document."""
    found: dict[str, Any] = refusing.get("/openapi.json").json()
    return found


def fields(document: dict[str, Any]) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Place, name and schema of all properties and query parameters but PAINT's."""
    for name, schema in document["components"]["schemas"].items():
        if name not in PAINT:
            for field, of in schema.get("properties", {}).items():
                yield f"{name}.{field}", field, of
    for path, operations in document["paths"].items():
        for method, operation in operations.items():
            for parameter in operation.get("parameters", ()):
                if parameter["in"] == "query":
                    place = f"{method} {path}?{parameter['name']}"
                    yield place, parameter["name"], parameter["schema"]


def kinds(schema: dict[str, Any]) -> set[str]:
    """Types that a value may have, without null; of lists and objects also those of entries."""
    if "$ref" in schema:
        return {schema["$ref"].rpartition("/")[2]}
    choices = schema.get("anyOf", schema.get("oneOf", ()))
    if choices:
        return set[str]().union(*map(kinds, choices)) - {"null"}
    entries = [*schema.get("prefixItems", ())]
    for name in ("items", "additionalProperties"):
        entries += [schema[name]] if isinstance(schema.get(name), dict) else []
    own = {schema.get("format", schema["type"])} if "type" in schema else set[str]()
    return own.union(*map(kinds, entries))


def test_no_name_of_before_is_left(document: dict[str, Any]):
    assert [place for place, name, _ in fields(document) if name in FORMER] == []


def test_a_sun_is_one_object_and_a_target_a_name(document: dict[str, Any]):
    wanted = {"sun": {"Sun", "SunAt"}, "target": {"string"}}
    # What a mount was calibrated under are effects of the model.
    others = [
        place
        for place, name, schema in fields(document)
        if name in wanted and not kinds(schema) <= wanted[name] and place != "MountOut.sun"
    ]
    assert others == []


def test_versions_are_integers(document: dict[str, Any]):
    others = [
        place
        for place, name, schema in fields(document)
        if re.search(r"(^|_)version$", name) and kinds(schema) != {"integer"}
    ]
    assert others == []


DAYS = ("EffectScope.since", "EffectScope.until", "AdoptIn.until", "ContradictedEffect.until")
COUNTED = ("MountOut.measurements", "PredictedErrorOut.measurements")


def test_times_have_the_name_of_a_time(document: dict[str, Any]):
    wrong = [
        place
        for place, name, schema in fields(document)
        if ("date-time" in kinds(schema)) != bool(TIME.match(name)) and place not in DAYS
    ]
    assert wrong == []


def test_measurements_are_ids_and_photographs_are_counted(document: dict[str, Any]):
    wanted = {"measurements": {"array", "string"}, "photographs": {"integer"}}
    others = [
        place
        for place, name, schema in fields(document)
        if name in wanted and kinds(schema) != wanted[name] and place not in COUNTED
    ]
    assert others == []


def test_numbers_have_their_unit_in_their_name(document: dict[str, Any]):
    without = [
        place
        for place, name, schema in fields(document)
        if "number" in kinds(schema) and not UNIT.search(name) and name not in WITHOUT_UNIT
    ]
    assert without == []
