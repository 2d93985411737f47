"""The OpenAPI document's operations, and bodies that fit them."""

from collections.abc import Iterator
from typing import Any

from fastapi.testclient import TestClient


def sample(schema: dict[str, Any], defs: dict[str, Any], depth: int = 0) -> Any:
    """Something that fits a schema, more or less, with all of its fields."""
    if "$ref" in schema:
        return sample(defs[schema["$ref"].rpartition("/")[2]], defs, depth)
    for several in ("anyOf", "oneOf"):
        if several in schema:
            return sample(
                next(one for one in schema[several] if one.get("type") != "null"), defs, depth
            )
    if "enum" in schema or "const" in schema:
        return schema.get("const", schema.get("enum", [None])[0])
    kind = schema.get("type", "object")
    if kind == "object":
        own = {
            name: sample(part, defs, depth + 1)
            for name, part in schema.get("properties", {}).items()
        }
        if isinstance(schema.get("additionalProperties"), dict):
            own["AA39"] = sample(schema["additionalProperties"], defs, depth + 1)
        return own
    if kind == "array":
        return [
            sample(part, defs, depth + 1)
            for part in schema.get("prefixItems", [schema.get("items", {})])
        ]
    if kind in ("number", "integer"):
        return schema.get("minimum", schema.get("exclusiveMinimum", 0) + 1)
    return {"string": schema.get("examples", ["AA39"])[0], "boolean": False}.get(kind)


def operations(client: TestClient) -> Iterator[tuple[str, str, dict[str, Any]]]:
    for path, methods in client.get("/openapi.json").json()["paths"].items():
        for method, operation in methods.items():
            yield path, method, operation
