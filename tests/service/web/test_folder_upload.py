"""Measurement folders that a browser or REST uploads as ZIP files."""

import io
import json
import os
import stat
import time
from pathlib import Path
from typing import Any
from zipfile import ZIP_LZMA, ZipFile, ZipInfo

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient

from service.base.settings import Settings
from service.jobs.uploads import delete_unused_uploads
from service.sources import archive
from tests.page import Page
from tests.service import real
from tests.service.archives import zipped
from tests.service.conftest import QUIET, paint_measurement, png
from tests.service.web.pages import HTML, make_key

PATH, UPLOADS = "/jobs/imports/upload", "/v1/jobs/imports/uploads"
LIMITS = {"max_image_bytes": 4096, "max_body_bytes_of_key": 2 * 2**20, "max_unpacked_bytes": 10**5}


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    """Small limits, and no folder of the server that may be imported."""
    return Settings(data_dir=tmp_path / "data", **QUIET, **LIMITS)


@pytest.fixture
def folder(tmp_path: Path, tower: Any, properties: Any) -> Path:
    """A heliostat that the store does not have, with a photograph and a file that is broken."""
    root = tmp_path / "field"
    for part in ("Properties", "Calibration"):
        (root / "AB01" / part).mkdir(parents=True)
    (root / "WRI1030197-tower-measurements.json").write_text(json.dumps(tower))
    document = root / "AB01" / "Properties" / "AB01-heliostat-properties.json"
    document.write_text(json.dumps(properties))
    calibration = root / "AB01" / "Calibration"
    (calibration / "7-calibration-properties.json").write_text(json.dumps(paint_measurement()))
    (calibration / "8-calibration-properties.json").write_text("{")
    (calibration / "7-flux.png").write_bytes(png(7))
    return root


def _upload(client: TestClient, data: bytes, path: str = PATH, **options: Any) -> Any:
    return client.post(path, files={"file": ("my field.zip", data)}, **options)


def _stored(settings: Settings) -> list[Path]:
    return list(settings.uploads_dir.glob("*"))


@pytest.mark.parametrize("top", ["", "my field/", "desk\\a\\"])
def test_upload_is_counted_then_imported_then_deleted(
    client: TestClient, settings: Settings, folder: Path, top: str
):
    (folder / "__MACOSX").mkdir()
    (folder / "__MACOSX" / "._7-flux.png").write_bytes(b"x")
    data = zipped(folder, top)
    answer = _upload(client, data, headers=HTML, follow_redirects=False)
    assert answer.status_code == 303, answer.text
    page = Page(client.get(answer.headers["Location"], headers=HTML).text)
    words = page.one("section", id="imports").words.replace("\xa0", " ")
    assert "1 heliostat and 1 measurement; 1 more cannot be read. 1 image, about" in words
    assert client.get("/v1/heliostats/AB01").status_code == 404
    form = {"folder": _stored(settings)[0].name, "uploaded": "true"}
    starts = [client.post("/jobs/imports", data=form, follow_redirects=False) for _ in range(2)]
    assert starts[0].headers["Location"] == starts[1].headers["Location"]  # one job
    assert real.worker(client).work()
    result = client.get(f"/v1{starts[0].headers['Location']}").json()["result"]
    assert (result["counts"]["heliostats new"], result["counts"]["images new"]) == (1, 1)
    assert _stored(settings) == []
    assert client.post("/jobs/imports", data=form).status_code == 422


def _entry(name: str, kind: int = stat.S_IFREG, method: int = 0) -> bytes:
    """A ZIP file of one entry."""
    buffer, info = io.BytesIO(), ZipInfo(name)
    info.external_attr, info.compress_type = kind << 16, method
    with ZipFile(buffer, "w") as file:
        file.writestr(info, b"/etc/passwd")
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"no ZIP", "no readable ZIP file (File is not a zip file); choose a .zip file"),
        (_entry("plant/../../out"), "plant/../../out leads outside of the folder; zip"),
        (_entry("..\\out"), "../out leads outside of the folder; zip"),
        (_entry("/out"), "/out leads outside of the folder; zip"),
        (_entry("link", stat.S_IFLNK), "link is a link or a device; zip"),
        (_entry("a", method=ZIP_LZMA), "a has an unusual compression; zip it with Deflate"),
        (_entry("a" * 256), "has a path of more than 255 bytes; rename it"),
        (_entry("."), "no readable ZIP file"),
        (_entry("a"), "plant.yaml"),
    ],
)
def test_bad_zip_file_is_refused(client: TestClient, settings: Settings, data: bytes, reason: str):
    answer = _upload(client, data, UPLOADS)
    assert answer.status_code == 422
    (error,) = answer.json()["errors"]
    assert error["field"] == "file"
    assert reason in error["message"]
    assert str(settings.data_dir) not in answer.text
    assert _stored(settings) == []
    assert reason.split(" (")[0] in Page(_upload(client, data, headers=HTML).text).words


def test_limits_of_size_and_entries(
    app: FastAPI, client: TestClient, folder: Path, monkeypatch: pytest.MonkeyPatch
):
    (folder / "large").write_bytes(os.urandom(10**5))  # more than a photograph may have
    assert "bytes unpacked, 100000 are the most" in _upload(client, zipped(folder)).text
    monkeypatch.setattr(archive, "MAX_ENTRIES", 7)
    assert "file: more than 7 entries" in _upload(client, zipped(folder)).text
    assert _upload(client, bytes(2 * 2**20), UPLOADS).status_code == 413
    assert client.post(UPLOADS, json={}).status_code == 415
    client.headers["Authorization"] = f"Bearer {make_key(app, 'read')}"
    assert _upload(client, b"").status_code == 403


def test_unused_uploads_are_deleted(client: TestClient, settings: Settings, folder: Path):
    """After a day, or when the job is cancelled; not while it waits."""
    names = [_upload(client, zipped(folder), UPLOADS).json()["folder"] for _ in range(3)]
    assert names[0].startswith("my-field-")
    jobs = [
        client.post("/v1/jobs/imports", json={"folder": name, "uploaded": True}).json()["id"]
        for name in names[:2]
    ]
    old = time.time() - 25 * 3600
    for name in names:
        os.utime(settings.uploads_dir / name, (old, old))
    delete_unused_uploads(real.runtime_of(client))
    assert {path.name for path in _stored(settings)} == set(names[:2])
    for job in jobs:
        client.post(f"/v1/jobs/{job}/cancel")
    assert _stored(settings) == []
    assert _upload(client, zipped(folder), UPLOADS).json()["n_measurements"] == 1
