"""Measurement folders that a browser or REST uploads as ZIP files."""

import io
import json
import os
import shutil
import stat
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any
from zipfile import ZIP_LZMA, ZipFile, ZipInfo

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from sqlalchemy import URL, func, select

from service.base.processes import file_lock
from service.base.settings import Settings
from service.jobs import uploads
from service.jobs.uploads import delete_unused_uploads
from service.sources import files
from service.store.job_tables import AuditRow, JobRow
from service.web.app import create_app
from tests.page import Page
from tests.service import access, real
from tests.service.archives import zipped
from tests.service.conftest import QUIET, FakeOperations, client_of, paint_measurement, png
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
    again = client.post("/jobs/imports", data=form, follow_redirects=False)
    assert again.headers["Location"] == starts[0].headers["Location"]


def _make_old(upload: Path) -> None:
    record = upload / "upload.json"
    document = json.loads(record.read_text()) | {"created_at": "2024-06-01T12:00:00Z"}
    record.write_text(json.dumps(document))


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
    too_large = _upload(client, zipped(folder))
    assert (too_large.status_code, "bytes unpacked, 100000 are the most" in too_large.text) == (
        413,
        True,
    )
    monkeypatch.setattr(files, "MAX_ENTRIES", 7)
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
    for name in names:
        _make_old(settings.uploads_dir / name)
    delete_unused_uploads(real.runtime_of(client))
    assert {path.name for path in _stored(settings)} == set(names[:2])
    for job in jobs:
        client.post(f"/v1/jobs/{job}/cancel")
    assert _stored(settings) == []
    assert _upload(client, zipped(folder), UPLOADS).json()["n_measurements"] == 1


@pytest.fixture
def stored(store_url: URL, tmp_path: Path) -> Iterator[TestClient]:
    """A service without heliostats, on each of the two databases."""
    url = store_url.render_as_string(hide_password=False).replace("+psycopg", "")
    options = Settings(data_dir=tmp_path / "data", database_url=url, **QUIET, **LIMITS)
    with client_of(create_app(options, FakeOperations())) as client:
        yield client


def test_uploads_are_listed_and_deleted(client: TestClient, settings: Settings, folder: Path):
    name = _upload(client, zipped(folder), UPLOADS).json()["folder"]
    noted = client.get("/v1/audit").json()["items"][0]
    assert (noted["action"], noted["subject"]) == ("upload.received", f"upload {name}")
    (listed,) = client.get(UPLOADS).json()["items"]
    assert listed["size_bytes"] == sum(
        path.stat().st_size for path in folder.rglob("*") if path.is_file()
    )
    counts = [listed[f"n_{what}"] for what in ("heliostats", "measurements", "images")]
    assert (listed["folder"], counts, listed["job"]) == (name, [1, 1, 1], None)
    page = Page(client.get("/jobs/start", headers=HTML).text)
    assert name in page.one("table", id="uploads").words
    job = client.post("/v1/jobs/imports", json={"folder": name, "uploaded": True}).json()["id"]
    assert client.get(UPLOADS).json()["items"][0]["job"] == job
    refused = client.delete(f"{UPLOADS}/{name}")
    assert (refused.status_code, refused.json()["detail"]) == (
        409,
        f"job {job} imports the upload {name}; cancel it first",
    )
    client.post(f"/v1/jobs/{job}/cancel")
    assert client.get(UPLOADS).json()["items"] == _stored(settings) == []
    names = [_upload(client, zipped(folder), UPLOADS).json()["folder"] for _ in range(2)]
    assert client.delete(f"{UPLOADS}/{names[0]}").status_code == 204
    gone = client.post(f"/jobs/imports/uploads/{names[1]}/delete", follow_redirects=False)
    assert gone.headers["Location"] == "/jobs/start#imports"
    assert _stored(settings) == []
    for name in (*names, "..", f".{names[0]}"):
        assert client.delete(f"{UPLOADS}/{name}").status_code in (404, 405)
    gone = client.post("/v1/jobs/imports", json={"folder": names[0], "uploaded": True})
    assert (gone.status_code, "there is no upload" in gone.text) == (404, True)
    with real.runtime_of(client).database.reading() as session:
        deleted = select(AuditRow.subject).where(AuditRow.action == "upload.deleted")
        assert session.scalars(deleted).all() == [f"upload {name}" for name in names]


def test_each_key_has_a_share_of_uploads(app: FastAPI, client: TestClient, folder: Path):
    """Its uploads do not shut out those of another key."""
    first, second = (
        access.bearer(access.make_key(app, name, "operate")) for name in ("one", "two")
    )
    data = zipped(folder)
    for _ in range(uploads.MAX_UPLOADS_OF_KEY):
        assert _upload(client, data, UPLOADS, headers=first).status_code == 201
    refused = _upload(client, data, UPLOADS, headers=first)
    assert refused.status_code == 429
    assert "file: 5 uploads of one wait" in refused.json()["detail"]
    assert _upload(client, data, UPLOADS, headers=second).status_code == 201
    name = client.get(UPLOADS, headers=first).json()["items"][0]["folder"]
    assert client.delete(f"{UPLOADS}/{name}", headers=first).status_code == 204
    (folder / "large").write_bytes(os.urandom(95_000))
    refused = _upload(client, zipped(folder), UPLOADS, headers=first)
    assert (refused.status_code, "with 100000 bytes are the most" in refused.text) == (429, True)


def test_upload_needs_space_for_its_folder_and_its_import(
    client: TestClient, settings: Settings, folder: Path, monkeypatch: pytest.MonkeyPatch
):
    """What others are unpacking counts as taken, too."""
    size = _upload(client, zipped(folder), UPLOADS).json()["size_bytes"]
    usage = shutil.disk_usage(settings.data_dir)

    def set_free(size_bytes: int) -> None:
        monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=size_bytes))

    set_free(2 * size - 1)
    refused = _upload(client, zipped(folder), UPLOADS)
    assert refused.status_code == 507
    assert f"the disk of the service has {2 * size - 1} free" in refused.json()["detail"]
    set_free(3 * size - 1)
    (other,) = _stored(settings)
    other.rename(other.with_name(f".{other.name}"))
    assert _upload(client, zipped(folder), UPLOADS).status_code == 507
    set_free(3 * size)
    assert _upload(client, zipped(folder), UPLOADS).status_code == 201


def test_upload_has_one_job_by_whatever_name(stored: TestClient, folder: Path):
    """Eight confirmations at the same time, by two keys, with and without an Idempotency-Key."""
    app: FastAPI = stored.app  # type: ignore[assignment]
    bearers = [access.bearer(access.make_key(app, name, "operate")) for name in ("one", "two")]
    name = _upload(stored, zipped(folder), UPLOADS, headers=bearers[0]).json()["folder"]

    def confirm(number: int) -> str:
        given = (name, f"./{name}", f"{name}/", f".//{name}/.")[number % 4]
        headers = bearers[number % 2]
        if number < 4:
            form = {"folder": given, "uploaded": "true"}
            answer = stored.post(
                "/jobs/imports", data=form, headers=headers, follow_redirects=False
            )
            return str(answer.headers["Location"])
        asked = headers | ({"Idempotency-Key": f"key-{number}"} if number > 5 else {})
        answer = stored.post(
            "/v1/jobs/imports", json={"folder": given, "uploaded": True}, headers=asked
        )
        assert answer.status_code == 202, answer.text
        return str(answer.headers["Location"]).removeprefix("/v1")

    with ThreadPoolExecutor(8) as pool:
        assert len(set(pool.map(confirm, range(8)))) == 1
    runtime = real.runtime_of(stored)
    with runtime.database.reading() as session:
        assert session.scalar(select(func.count()).select_from(JobRow)) == 1
    _make_old(runtime.settings.uploads_dir / name)
    delete_unused_uploads(runtime)
    assert len(stored.get(UPLOADS, headers=bearers[0]).json()["items"]) == 1
    assert real.worker(stored).work()
    assert stored.get("/v1/heliostats/AB01", headers=bearers[0]).status_code == 200
    assert stored.get(UPLOADS, headers=bearers[0]).json()["items"] == []


def test_import_of_a_server_folder_deletes_no_upload(
    client: TestClient, settings: Settings, folder: Path
):
    name = _upload(client, zipped(folder), UPLOADS).json()["folder"]
    object.__setattr__(settings, "import_root", folder)
    client.post("/v1/jobs/imports", json={"folder": name})
    assert real.worker(client).work()
    assert [upload.name for upload in _stored(settings)] == [name]


def test_page_of_an_upload_does_not_read_its_folder(
    client: TestClient, settings: Settings, folder: Path, monkeypatch: pytest.MonkeyPatch
):
    name = _upload(client, zipped(folder), UPLOADS).json()["folder"]
    shutil.rmtree(settings.uploads_dir / name / "content")
    page = client.get(f"/jobs/start?folder={name}&uploaded=true", headers=HTML)
    assert "1 more cannot be read" in page.text.replace("\xa0", " ")


# Unpacks until it is killed.
_UNPACKING = """
import sys, time
from pathlib import Path
from service.base.settings import Settings
from service.jobs import uploads
from service.twin.runtime import Runtime
uploads._count = lambda *_: print("unpacked", flush=True) or time.sleep(600)
runtime = Runtime.from_settings(Settings(data_dir=Path(sys.argv[1])), object())
uploads.receive_upload(runtime, open(sys.argv[2], "rb"), "plant.zip", "tester")
"""


@pytest.mark.full
def test_what_a_killed_process_unpacked_is_deleted_at_the_next_start(
    app: FastAPI, settings: Settings, folder: Path, tmp_path: Path
):
    """Not what a living process is unpacking."""
    with client_of(app):  # makes the database
        pass
    (tmp_path / "plant.zip").write_bytes(zipped(folder))
    command = [
        sys.executable,
        "-c",
        _UNPACKING,
        str(settings.data_dir),
        str(tmp_path / "plant.zip"),
    ]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "unpacked\n"
            with client_of(create_app(settings, FakeOperations())) as client:
                assert len(_stored(settings)) == 1
                assert client.get(UPLOADS).json()["items"] == []
        finally:
            process.kill()
    with client_of(create_app(settings, FakeOperations())):
        assert _stored(settings) == []


def test_left_overs_are_deleted_unless_a_process_works_on_them(
    client: TestClient, settings: Settings
):
    for name in (".dead", ".alive", "without-record"):
        (settings.uploads_dir / name).mkdir(parents=True)
    (settings.uploads_dir / "file").touch()
    with file_lock(settings.uploads_dir / ".alive" / "lock"):
        delete_unused_uploads(real.runtime_of(client))
        assert [path.name for path in _stored(settings)] == [".alive"]
    delete_unused_uploads(real.runtime_of(client))
    assert _stored(settings) == []


def test_a_folder_of_another_plant_is_refused_at_once(
    client: TestClient, settings: Settings, folder: Path, tower: Any
):
    latitude, longitude, altitude = tower["power_plant_properties"]["coordinates"]
    tower["power_plant_properties"]["coordinates"] = [latitude + 1, longitude, altitude]
    (folder / "WRI1030197-tower-measurements.json").write_text(json.dumps(tower))
    answer = _upload(client, zipped(folder), UPLOADS)
    assert answer.status_code == 409, answer.text
    assert "take another store for another plant" in answer.json()["detail"]
    assert _stored(settings) == []
