"""Schemathesis over the whole OpenAPI document, with the key of each role: what is answered is what
is documented.

``HELIOTWIN_FUZZ_EXAMPLES`` sets how many requests of each kind are made, 2 unless set; 200 take
about an hour.
"""

import os
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import jsonschema
import pytest
import schemathesis
from fastapi import FastAPI
from fastapi.testclient import TestClient
from hypothesis import HealthCheck, Phase, given
from hypothesis import settings as limits
from hypothesis.errors import Unsatisfiable
from schemathesis import GenerationMode
from schemathesis.checks import not_a_server_error
from schemathesis.specs.openapi.checks import content_type_conformance, status_code_conformance

from service.base.settings import Settings
from service.web.app import create_app
from service.web.auth.security import Role
from tests.service.access import bearer, make_key
from tests.service.conftest import (
    QUIET,
    FakeOperations,
    client_of,
    png,
    poster,
    properties_document,
    serving,
    tower_document,
)
from tests.waiting import WAIT_LIMIT_S

EXAMPLES = int(os.environ.get("HELIOTWIN_FUZZ_EXAMPLES", "2"))
CHECKS = [not_a_server_error, status_code_conformance, content_type_conformance]
SUN = {"azimuth_deg": 180, "elevation_deg": 45}


@pytest.fixture(scope="module")
def served(
    tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[tuple[str, FastAPI, dict[str, dict[str, str]]]]:
    """The service with some of everything in it behind a socket, and headers of nobody and of a key
    of each role.
    """
    settings = Settings(data_dir=tmp_path_factory.mktemp("fuzz"), max_image_bytes=200_000, **QUIET)
    app = create_app(settings, FakeOperations())
    with client_of(app) as client, pytest.MonkeyPatch.context() as patch:
        patch.setattr("service.web.root.health.default_predictor", lambda: None)
        _fill(client)
        headers = {role.value: bearer(make_key(app, f"key-{role}", role)) for role in Role} | {
            "none": {}
        }
        with serving(app, lifespan="off") as address:
            yield address, app, headers


def _fill(client: TestClient) -> None:
    client.put("/v1/plant", json=tower_document())
    client.put("/v1/heliostats/AA39", json=properties_document())
    poster(client)(png(1), id="1")
    client.post("/v1/heliostats/AA39/surfaces", json={})
    made = client.post(
        "/v1/forecasts", json={"heliostat": "AA39", "target": "lower", "sun": SUN, "resolution": 16}
    )
    assert made.status_code == 201
    client.post(client.post("/v1/jobs/predictions", json={}).headers["Location"] + "/cancel")


def _require_its_schema(document: dict[str, Any], case: Any, response: Any) -> None:
    """The answer's JSON is what the document says of it.

    Schemathesis' own response_schema_conformance (4.32) takes our tuples, `prefixItems`, for
    invalid schemas.
    """
    media_type = response.headers.get("content-type", [""])[0].partition(";")[0]
    if not media_type.endswith("json"):
        return
    answers = document["paths"][case.operation.path][case.operation.method]["responses"]
    described = answers[str(response.status_code)].get("content", {})
    assert media_type in described, (case.operation.label, response.status_code, media_type)
    schema = described[media_type]["schema"]
    jsonschema.validate(response.json(), {**schema, "components": document["components"]})


def _try(document: dict[str, Any], cases: Any, headers: dict[str, str], met: Counter[int]) -> None:
    @limits(
        max_examples=EXAMPLES,
        deadline=None,
        derandomize=True,
        database=None,
        phases=[Phase.explicit, Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(case=cases)
    def check(case: Any) -> None:
        response = case.call(timeout=WAIT_LIMIT_S, headers=headers)
        met[response.status_code] += 1
        case.validate_response(response, checks=CHECKS)
        _require_its_schema(document, case, response)

    with suppress(Unsatisfiable):  # some operations take nothing that could be wrong
        check()


@pytest.mark.parametrize("role", ["none", *(role.value for role in Role)])
def test_what_is_answered_is_what_is_documented(served: Any, role: str):
    address, app, headers = served
    met: Counter[int] = Counter()
    for found in schemathesis.openapi.from_url(f"{address}/openapi.json").get_all_operations():
        operation = found.ok()
        if operation.label == "GET /v1/jobs/{number}/events":
            continue  # a stream that ends with its job
        for mode in (GenerationMode.POSITIVE, GenerationMode.NEGATIVE):
            _try(app.openapi(), operation.as_strategy(generation_mode=mode), headers[role], met)
    assert sum(met.values()) > 40
    if role == "none":
        assert set(met) <= {200, 204, 400, 401, 403, 413, 415, 422}
    else:
        assert met[200] > 5
