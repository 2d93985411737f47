"""What every refusal has."""

from typing import Any

from service.web.responses.openapi import Problem


def check(answer: Any, status: int) -> dict[str, Any]:
    assert answer.status_code == status
    assert answer.headers["Content-Type"] == "application/problem+json"
    document: dict[str, Any] = answer.json()
    Problem.model_validate(document)
    assert document["status"] == status
    assert document["request_id"] == answer.headers["X-Request-ID"]
    return document
