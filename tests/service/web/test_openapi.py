"""The OpenAPI document teaches: summaries, descriptions with units, and examples of a real run."""

import re
from collections.abc import Iterator
from typing import Any

import jsonschema
import pytest
from fastapi.testclient import TestClient

UNITS = {
    "bits": "[bit]",
    "c": "[°C]",
    "days": "[days]",
    "deg": "[deg]",
    "m": "[m]",
    "m2": "[m2]",
    "m_s": "[m/s]",
    "minutes": "[min]",
    "mm": "[mm]",
    "mrad": "[mrad]",
    "per_m": "[1/m]",
    "per_rad": "[1/rad]",
    "px": "[px]",
    "rad": "[rad]",
    "s": "[s]",
    "w": "[W]",
    "w_m2": "[W/m2]",
}
"""What a description says of the unit that a name ends in."""
ENDING = re.compile(rf"(?:^|_)({'|'.join(sorted(UNITS, key=len, reverse=True))})$")
TAGS = (
    "plant",
    "heliostats",
    "measurements",
    "surfaces",
    "forecasts",
    "mounts",
    "studies",
    "jobs",
    "alarms",
    "audit",
    "session",
    "health",
)
"""The order of the work."""


@pytest.fixture(scope="module")
def document(refusing: TestClient) -> dict[str, Any]:
    found: dict[str, Any] = refusing.get("/openapi.json").json()
    return found


def operations(document: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    for path, methods in document["paths"].items():
        for method, operation in methods.items():
            yield f"{method} {path}", operation


def properties(document: dict[str, Any]) -> Iterator[tuple[str, str, str]]:
    """Place, name and description of all properties and parameters."""
    for schema, content in document["components"]["schemas"].items():
        for name, of in content.get("properties", {}).items():
            yield f"{schema}.{name}", name, of.get("description", "")
    for place, operation in operations(document):
        for of in operation.get("parameters", ()):
            yield f"{place}?{of['name']}", of["name"], of.get("description", "")


def contents(document: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Place and content of all bodies and of all answers below 300, but for binary ones."""
    for place, operation in operations(document):
        answers = {status: of for status, of in operation["responses"].items() if status < "300"}
        if "requestBody" in operation:
            answers["body"] = operation["requestBody"]
        for what, of in answers.items():
            for media_type, content in of.get("content", {}).items():
                if content["schema"].get("format") != "binary":
                    yield f"{place} {what} {media_type}", content


def test_every_operation_has_a_short_summary(document: dict[str, Any]):
    wrong = {}
    for place, operation in operations(document):
        summary = operation.get("summary", "")
        is_name = summary.lower().replace(" ", "_") == operation["operationId"]
        if is_name or not re.fullmatch(r"[A-Z][^.]{6,69}", summary):
            wrong[place] = summary
    assert wrong == {}


def test_summaries_differ(document: dict[str, Any]):
    places: dict[str, list[str]] = {}
    for place, operation in operations(document):
        places.setdefault(operation["summary"], []).append(place)
    several = [found for found in places.values() if len(found) > 1]
    assert several == []


def test_every_property_and_parameter_is_described(document: dict[str, Any]):
    assert [place for place, _, description in properties(document) if len(description) < 3] == []


def test_descriptions_have_the_unit(document: dict[str, Any]):
    missing = [
        (place, description)
        for place, name, description in properties(document)
        if (unit := ENDING.search(name)) and UNITS[unit[1]] not in description
    ]
    assert missing == []


def test_every_body_and_answer_has_an_example_that_is_valid(document: dict[str, Any]):
    without, invalid = [], {}
    for place, content in contents(document):
        if "example" not in content:
            without.append(place)
            continue
        schema = {**content["schema"], "components": document["components"]}
        try:
            jsonschema.validate(content["example"], schema)
        except jsonschema.ValidationError as error:
            invalid[place] = f"{error.json_path}: {error.message[:200]}"
    assert without == []
    assert invalid == {}


def test_tags_are_in_the_order_of_the_work(document: dict[str, Any]):
    assert tuple(tag["name"] for tag in document["tags"]) == TAGS
    used = {tag for _, operation in operations(document) for tag in operation["tags"]}
    assert used == set(TAGS)


def test_examples_are_small_and_of_no_machine(document: dict[str, Any]):
    sizes = {place: len(str(content["example"])) for place, content in contents(document)}
    assert max(sizes.values()) < 5000
    assert not [place for place, c in contents(document) if "/tmp" in str(c["example"])]
