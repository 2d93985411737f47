"""Input that means harm: no way out of the store, no crash, nothing of it taken for
what it is not.
"""

import json
import struct
import zlib
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pytest
import schemathesis
from fastapi import FastAPI
from fastapi.testclient import TestClient
from hypothesis import HealthCheck, Phase, given
from hypothesis import settings as limits
from hypothesis.errors import Unsatisfiable
from schemathesis import GenerationMode
from schemathesis.checks import not_a_server_error

from service.base.settings import Settings
from tests.service.conftest import QUIET, FakeOperations, Post, metadata, png, poster, serving
from tests.service.sources.pictures import gray_tiff, jpeg_of_scans, tiff
from tests.waiting import WAIT_LIMIT_S

JSON = {"Content-Type": "application/json"}


def chunk(name: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))


def png_of(width: int, height: int, data: bytes, depth: int = 8) -> bytes:
    """A PNG that says it has this size, whatever its data hold."""
    header = struct.pack(">IIBBBBB", width, height, depth, 0, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", data) + chunk(b"IEND", b"")
    )


# --- names
# --------------------------------------------------------------------------------------------------

NAMES = [
    "..",
    "../../etc/passwd",
    "..%2f..%2fetc%2fpasswd",
    "%2e%2e%2f",
    "..\\..\\x",
    "/etc/passwd",
    "a/b",
    "a\x00b",
    "a%00b",
    "CON.txt",
    "~root",
    "$(id)",
    "' OR '1'='1",
    "x'; DROP TABLE heliostats; --",
    "a%0d%0aSet-Cookie:%20x=1",
    "a" * 97,
    "А39",
    "A39\u202e",
    "",
    " ",
]


@pytest.mark.parametrize("name", NAMES)
def test_bad_name_in_a_path_is_refused(refusing: TestClient, name: str):
    # Dots are spelled out, for clients resolve them themselves.
    for spelled in (quote(name, safe=""), quote(name, safe="/%")):
        for path in (
            "heliostats/{}",
            "targets/{}",
            "heliostats/{}/measurements",
            "heliostats/AA39/measurements/{}",
        ):
            url = f"/v1/{path.format(spelled.replace('.', '%2e'))}"
            for answer in (refusing.get(url), refusing.put(url, json={})):
                assert answer.status_code in (404, 405, 422), (answer.request.method, url)
                assert answer.headers["Content-Type"] == "application/problem+json"
                assert "root:" not in answer.text


@pytest.mark.parametrize("name", NAMES)
def test_bad_name_in_a_body_is_refused(
    refusing: TestClient, refused_post: Post, properties: Any, name: str
):
    sun = {"azimuth_deg": 180, "elevation_deg": 45}
    for path, body in (
        ("heliostats", {"name": name, "properties": properties}),
        ("forecasts", {"heliostat": name, "target": "lower", "sun": sun}),
        ("forecasts", {"heliostat": "AA39", "target": name, "sun": sun}),
        ("heliostats/AA39/surfaces", {"measurements": [name]}),
        ("jobs/predictions", {"heliostats": [name]}),
    ):
        assert refusing.post(f"/v1/{path}", json=body).status_code == 422, path
    assert refused_post(id=name).status_code == 422
    assert refused_post(target=name).status_code in (404, 422)


@pytest.mark.parametrize(
    "filename",
    ["../../x.png", "a\x00.png", 'x"; evil="1.png', "x.php", "a" * 5000, "x\r\nEvil: 1.png"],
)
def test_name_of_an_uploaded_file_means_nothing(
    client: TestClient, settings: Settings, filename: str, tmp_path: Path
):
    before = {path for path in tmp_path.rglob("*") if settings.data_dir not in path.parents}
    answer = client.post(
        "/v1/heliostats/AA39/measurements",
        files={"image": (filename, png(), "text/html")},
        data={"metadata": json.dumps(metadata())},
    )
    assert answer.status_code in (201, 400)
    assert {path for path in tmp_path.rglob("*") if settings.data_dir not in path.parents} == before
    for path in (settings.data_dir / "images").rglob("*"):
        assert len(path.name) in (2, 62)


# --- images
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("cut", [0, 1, 8, 20, 33, 60, -1, -20])
def test_truncated_image_is_refused(refused_post: Post, cut: int):
    assert refused_post(png(size=(64, 64))[:cut]).status_code in (415, 422)


@pytest.mark.parametrize(
    "image",
    [
        png_of(30_000, 30_000, zlib.compress(bytes(10**8), 9)),
        png_of(2**31 - 1, 2**31 - 1, b""),
        png_of(0, 0, b""),
        png_of(65_535, 65_535, b"", depth=16),
        b"\xff\xd8\xff\xc0\x00\x11\x08\xff\xff\xff\xff\x03\x01\x22\x00\x02\x11\x01\x03\x11\x01\xff\xd9",
        b"BM"
        + struct.pack("<IHHIIiiHHIIiiII", 54, 0, 0, 54, 40, 2**30, 2**30, 1, 24, 0, 0, 0, 0, 0, 0),
        b"BM"
        + struct.pack(
            "<IHHIIiiHHIIiiII", 54, 0, 0, 54, 40, -(2**31), -(2**31), 1, 24, 0, 0, 0, 0, 0, 0
        ),
        b"II*\x00" + struct.pack("<I", 8) + struct.pack("<H", 65_535) + b"\x00" * 100,
        b"II*\x00" + struct.pack("<I", 4) + b"\x01\x00" * 20,
    ],
    ids=["bomb", "huge", "empty", "deep", "jpeg", "bmp", "negative bmp", "many tags", "tiff loop"],
)
def test_image_that_says_it_is_huge_is_refused_unread(refused_post: Post, image: bytes):
    assert refused_post(image).status_code in (413, 415, 422)


@pytest.mark.parametrize(
    "image",
    [
        gray_tiff((256, 3, 1, 30_000)),
        gray_tiff(_277=(3, 0, 0)),
        tiff(*[(60_000 + tag, 1, 100_000, 8) for tag in range(1000)], data=bytes(100_000)),
        jpeg_of_scans(2501),
    ],
    ids=["two widths", "no samples", "shared values", "scans"],
)
def test_image_that_costs_more_than_it_is_worth_is_refused(refused_post: Post, image: bytes):
    answer = refused_post(image)
    assert answer.status_code == 422
    assert answer.json()["detail"].startswith("image: ")


@pytest.mark.parametrize(
    "image",
    [
        b"GIF89a/*" + b"A" * 50 + b"*/=1;alert(1)",
        b"<svg xmlns='http://www.w3.org/2000/svg' onload='alert(1)'/>",
        b"<html><script>alert(1)</script>",
        b"PK\x03\x04" + b"A" * 100,
        b"%PDF-1.7" + b"A" * 100,
        b"BM<script>alert(1)</script>" + b"A" * 100,
        b"\x89PNG\r\n\x1a\n<script>alert(1)</script>",
        b"\xff\xd8\xff<script>alert(1)</script>",
    ],
)
def test_what_only_looks_like_an_image_is_refused(refused_post: Post, image: bytes):
    assert refused_post(image).status_code in (415, 422)


def test_polyglot_is_served_as_the_image_that_it_is(client: TestClient, post: Post):
    """An image with a page behind its end is kept as it came, and no browser may take it for a
    page.
    """
    answer = post(png() + b"<html><script>alert(1)</script></html>", id="1")
    if answer.status_code == 201:
        served = client.get("/v1/heliostats/AA39/measurements/1/image")
        assert served.headers["Content-Type"] == "image/png"
        assert served.headers["X-Content-Type-Options"] == "nosniff"
        assert "default-src 'self'" in served.headers["Content-Security-Policy"]
    else:
        assert answer.status_code in (415, 422)


# --- numbers
# --------------------------------------------------------------------------------------------------

NUMBERS = [
    "NaN",
    "Infinity",
    "-Infinity",
    "1e999",
    "-1e999",
    "1e400",
    "9" * 400,
    '"NaN"',
    '"inf"',
    "null",
    "[]",
]


@pytest.mark.parametrize("number", NUMBERS)
def test_numbers_that_are_none_are_refused(
    refusing: TestClient, refused_post: Post, tower: Any, number: str
):
    sun = f'{{"azimuth_deg": {number}, "elevation_deg": 45}}'
    plane = f'{{"center": [0, {number}, 30], "normal": [0, 1, 0], "width": 8, "height": 8}}'
    corner = json.dumps(tower).replace("87.0", number, 1)
    for method, path, body in (
        ("POST", "forecasts", f'{{"heliostat": "AA39", "target": "lower", "sun": {sun}}}'),
        ("POST", "jobs/forecasts", f'{{"target": "lower", "sun": {sun}}}'),
        ("PUT", "targets/new", f'{{"plane": {plane}}}'),
        ("PUT", "plant", corner),
    ):
        answer = refusing.request(method, f"/v1/{path}", content=body, headers=JSON)
        assert answer.status_code == 422, (path, answer.text)
    form = json.dumps(metadata()).replace("160.0", number)
    assert refused_post(raw=form).status_code == 422


@pytest.mark.parametrize(
    "query", ["limit=NaN", "limit=1e9", "limit=-1", "limit=1;DROP TABLE jobs", "after=' OR 1=1 --"]
)
def test_queries_are_checked(refusing: TestClient, query: str):
    for path in ("heliostats", "forecasts", "jobs", "audit"):
        assert refusing.get(f"/v1/{path}?{query}").status_code == 422, path


@pytest.mark.parametrize("state", ["done' OR '1'='1", "done; DROP TABLE jobs", "nothing"])
def test_filters_are_checked(refusing: TestClient, state: str):
    assert refusing.get("/v1/jobs", params={"state": state}).status_code == 422
    assert refusing.get("/v1/jobs", params={"kind": state}).status_code in (200, 422)


def test_deep_json_does_not_break_the_stack(refusing: TestClient):
    for deep in ("[" * 100_000, '{"a":' * 50_000, "[" * 50_000 + "]" * 50_000):
        for method, path in (("POST", "forecasts"), ("PUT", "plant"), ("POST", "jobs/predictions")):
            assert (
                refusing.request(method, f"/v1/{path}", content=deep, headers=JSON).status_code
                == 413
            )


# --- headers
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "value",
    ["a\r\nEvil: 1", "a\nEvil: 1", "' OR 1=1 --", "x" * 10_000, "\x00\x01", "é", "${jndi:x}"],
)
def test_headers_are_not_echoed_unchecked(refusing: TestClient, value: str):
    raw = value.encode("latin-1", "replace")
    for name in (
        "X-Request-ID",
        "Last-Event-ID",
        "Idempotency-Key",
        "Accept",
        "Cookie",
        "Authorization",
        "Range",
    ):
        answer = refusing.get("/v1/jobs/1/events", headers={name: raw})
        assert answer.status_code in (401, 404, 406, 422), name
        assert "evil" not in answer.headers
        assert value not in "".join(answer.headers.values()), name


# --- the whole document
# -----------------------------------------------------------------------------------------------


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    return Settings(
        data_dir=tmp_path / "data", max_image_bytes=200_000, max_image_pixels=500_000, **QUIET
    )


@pytest.fixture
def served(app: FastAPI, client: TestClient, operations: FakeOperations) -> Iterator[str]:
    """The service with some of everything in it, behind a socket."""
    post = poster(client)
    post(png(1), id="1")
    client.post("/v1/heliostats/AA39/surfaces", json={})
    sun = {"azimuth_deg": 180, "elevation_deg": 45}
    client.post(
        "/v1/forecasts", json={"heliostat": "AA39", "target": "lower", "sun": sun, "resolution": 16}
    )
    client.post(client.post("/v1/jobs/predictions", json={}).headers["Location"] + "/cancel")
    with serving(app, lifespan="off") as address:
        yield address


def try_operation(cases: Any) -> None:
    @limits(
        max_examples=4,
        deadline=None,
        derandomize=True,
        database=None,
        phases=[Phase.explicit, Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(case=cases)
    def check(case: Any) -> None:
        case.validate_response(case.call(timeout=WAIT_LIMIT_S), checks=[not_a_server_error])

    with suppress(Unsatisfiable):  # some operations take nothing that could be wrong
        check()


@pytest.mark.full
def test_no_request_that_the_document_allows_or_forbids_breaks_the_service(
    served: str, app: FastAPI
):
    """Schemathesis makes requests, right and wrong ones, from the OpenAPI document; none may end in
    a 5xx.
    """
    tried = []
    for found in schemathesis.openapi.from_url(f"{served}/openapi.json").get_all_operations():
        operation = found.ok()
        if operation.path == "/readyz":
            continue  # 503 is its way to say that the weights cannot be loaded
        for mode in (GenerationMode.POSITIVE, GenerationMode.NEGATIVE):
            try_operation(operation.as_strategy(generation_mode=mode))
        tried.append(operation.label)
    assert len(tried) > 25
