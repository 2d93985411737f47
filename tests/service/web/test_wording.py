"""Refusals are in plain words, with the field's path: each operation is tried with wrong values."""

import json
import re
from typing import Any

import pytest
from fastapi.testclient import TestClient

from service.base import validation
from service.drawing.templates import model_in_words
from service.web.responses import problems
from tests.service.conftest import metadata, png
from tests.service.web.documents import operations, sample
from tests.service.wrong import RAW, wrong_everywhere

IN_TEXT = ["", "a b", "-1", "1e999", "nan", "x" * 300, "99999999999999999999"]
PYTHON = re.compile(r"\b(?:dict|dictionary|tuple|set|instance|iterable|None|timezone info)\b")


@pytest.fixture
def kinds(monkeypatch: pytest.MonkeyPatch) -> set[str]:
    """The kinds of errors that were met."""
    met: set[str] = set()

    def spying(entry: Any) -> str:
        met.add(entry["type"])
        return validation.message_of(entry)

    monkeypatch.setattr(problems, "message_of", spying)
    return met


def check(answer: Any, sent: Any) -> None:
    if answer.status_code == 422:
        problem = answer.json()
        for text in (problem["detail"], *(error["message"] for error in problem.get("errors", ()))):
            assert not RAW.search(text), (sent, text)
            assert not PYTHON.search(text), (sent, text)
        for error in problem.get("errors", ()):
            assert re.fullmatch(r"[\w .:$-]+", error["field"]), error
            assert not re.search(
                r"function-|tuple\[|list\[|constrained|union|json-or", error["field"]
            ), error
    assert answer.status_code < 500, (sent, answer.text)


@pytest.mark.full
def test_messages_for_wrong_bodies_are_plain(client: TestClient, kinds: set[str]):
    defs = client.get("/openapi.json").json()["components"]["schemas"]
    headers = {"Content-Type": "application/json"}
    for path, method, operation in operations(client):
        content = operation.get("requestBody", {}).get("content", {})
        if "application/json" not in content:
            continue
        url = path.replace("{name}", "ZZ99").replace("{measurement}", "1").replace("{number}", "1")
        for schema in content["application/json"]["schema"].get(
            "oneOf", [content["application/json"]["schema"]]
        ):
            for body in wrong_everywhere(sample(schema, defs)):
                check(
                    client.request(method, url, content=json.dumps(body), headers=headers),
                    (method, url, body),
                )
    assert len(kinds) > 15


@pytest.mark.full
def test_messages_for_wrong_parameters_are_plain(client: TestClient):
    for path, method, operation in operations(client):
        given = {"name": "AA39", "measurement": "1", "number": "1", "version": "1"}
        for parameter in operation.get("parameters", ()):
            for value in IN_TEXT:
                url = path.format(
                    **given
                    | ({parameter["name"]: value or "%20"} if parameter["in"] == "path" else {})
                )
                query = {parameter["name"]: value} if parameter["in"] == "query" else {}
                headers = {parameter["name"]: value} if parameter["in"] == "header" else {}
                check(
                    client.request(method, url, params=query, headers=headers),
                    (method, url, query, headers),
                )


def test_messages_for_wrong_forms_are_plain(client: TestClient):
    url = "/v1/heliostats/AA39/measurements"
    sound: dict[str, Any] = metadata(
        id="1", corners=[[0, 0]] * 4, motor_position=[1, 2], focal_spot_m=[50, 6, 80]
    )
    file = {"image": ("spot.png", png(), "image/png")}
    for body in wrong_everywhere(sound):
        check(client.post(url, files=file, data={"metadata": json.dumps(body)}), body)
    for text in ("", "{", "[", "nonsense", "\x00"):
        check(client.post(url, files=file, data={"metadata": text}), text)
    for form in ({"metadata": "{}"}, {"metadata": json.dumps(sound), "image": "text"}):
        answer = client.post(url, data=form, files={"more": ("a", b"b")})
        assert answer.status_code == 422
        check(answer, form)
    check(client.post(url, files=file), "no metadata")


@pytest.mark.parametrize("body", ["", "{", '{"heliostat": oops}', "[1,", "\xff", "nul", '"' * 3])
def test_messages_for_invalid_json_are_plain(refusing: TestClient, body: str):
    headers = {"Content-Type": "application/json"}
    answer = refusing.post("/v1/forecasts", content=body.encode("latin-1"), headers=headers)
    assert answer.status_code in (400, 422)
    assert not RAW.search(answer.text)
    assert re.search("; (make it one JSON document|send it)", answer.json()["detail"])


def test_versions_of_the_model_are_described_in_words():
    problem = [model_in_words(version) for version in ("1:none", "3:sun_shape+soiling")]
    assert problem == ["version 1, no effects", "version 3, sun shape, soiling"]
