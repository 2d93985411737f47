"""The image and the composition as a plant runs them: from a clean clone, on real photographs,
through a week of faults.

The tests run the commands of docs/how-to/administrator.
"""

import json
import os
import re
import subprocess
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest

from tests.docker.engine import binary
from tests.waiting import until

from . import engine
from .engine import Client, Composition

pytestmark = pytest.mark.timeout(3600)


@pytest.fixture(scope="module")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    reason = engine.absent()
    if reason:
        pytest.skip(reason)
    return engine.clone(tmp_path_factory.mktemp("clone") / "heliotwin")


@pytest.fixture(scope="module")
def version(checkout: Path) -> Iterator[str]:
    """The tag of an image that was built from a clean clone."""
    tag = f"test-{uuid.uuid4().hex[:8]}"
    engine.build_heliotwin(checkout, f"heliotwin:{tag}")
    yield tag
    engine.run("docker", "rmi", "--force", f"heliotwin:{tag}")


@contextmanager
def composed(
    checkout: Path, tag: str, stj: Path, images: Mapping[str, str] | None = None
) -> Iterator[Composition]:
    """A composition that runs, and may import the real measurements; removed at the end.

    ``images`` are those of services that start from others than the file names.
    """
    made = Composition(checkout, tag, stj.resolve().parent)
    if images:
        made.instead(images)
    try:
        made.up()
        yield made
    finally:
        made.tear_down()


@pytest.fixture
def backups(tmp_path: Path) -> Path:
    """A folder that the containers' user may write to."""
    folder = tmp_path / "backup"
    folder.mkdir()
    if os.geteuid() == 0:
        os.chown(folder, 10001, 10001)
    else:
        folder.chmod(0o777)
    return folder


def imported(client: Client, stj: Path) -> dict[str, Any]:
    """What a job that imports the real measurements counted."""
    job = client.post("/v1/jobs/imports", {"folder": stj.name}).headers["Location"]
    counts: dict[str, Any] = client.done(job)["result"]["counts"]
    return counts


def unchanged(counts: dict[str, int]) -> dict[str, int]:
    """The counts of an import that finds everything there already."""
    return {
        re.sub(r" (new|changed)\b", " unchanged", name): count
        for name, count in sorted(counts.items())
    }


def kept(client: Client) -> dict[str, Any]:
    """All that must come through an upgrade and a restoration."""
    names = [item["name"] for item in client.get("/v1/heliostats")["items"]]
    jobs = [item["id"] for item in client.get("/v1/jobs")["items"]]  # without results
    heliostats = {
        name: {
            what: client.get(f"/v1/heliostats/{name}/{what}")
            for what in ("measurements", "surfaces")
        }
        for name in names
    }
    whole = [client.get(f"/v1/jobs/{number}") for number in jobs]
    return heliostats | {
        "jobs": whole,
        "targets": client.get("/v1/targets"),
        "models": client.get("/v1/models"),
    }


def versions(client: Client) -> dict[str, int]:
    """How many surfaces each heliostat has."""
    names = [item["name"] for item in client.get("/v1/heliostats")["items"]]
    return {name: len(client.get(f"/v1/heliostats/{name}/surfaces")["items"]) for name in names}


def test_image_starts_without_a_place_to_write(version: str):
    """Read-only, as the composition runs it, each command says nothing that it was not asked."""
    command = [
        "docker",
        "run",
        "--rm",
        "--read-only",
        "--tmpfs",
        "/tmp",
        "--network",
        "none",
        f"heliotwin:{version}",
    ]
    done = subprocess.run([*command, "--help"], capture_output=True, text=True, check=True)
    assert "serve" in done.stdout
    assert done.stderr == ""


@pytest.fixture(scope="module")
def monitors(checkout: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    """Images with real Prometheus and Alertmanager, by the services that they are for."""
    programs = {
        "prometheus": (binary("prometheus"), "tsdb.path"),
        "alertmanager": (binary("alertmanager", "prometheus-alertmanager"), "path"),
    }
    folder = tmp_path_factory.mktemp("monitors")
    images = {
        name: engine.build_monitor(program, name, kind, folder / name, f"heliotwin-test-{name}")
        for name, (program, kind) in programs.items()
    }
    yield images
    engine.run("docker", "rmi", "--force", *images.values())


@pytest.fixture
def monitored(
    checkout: Path, version: str, stj: Path, monitors: dict[str, str]
) -> Iterator[Composition]:
    """The composition's profile as it is, but for the images, and Grafana, which there is no
    program of in Debian.
    """
    with composed(checkout, version, stj, monitors) as running:
        running("--profile", "monitoring", "up", "-d", *monitors)
        yield running


def test_monitoring_reports_that_service_or_worker_is_away(
    monitored: Composition, monitors: dict[str, str]
):
    base = {
        name: f"http://127.0.0.1:{monitored.environment[f'HELIOTWIN_{name.upper()}_PORT']}"
        for name in monitors
    }

    def asked(name: str, path: str) -> Any:
        try:
            answer = httpx.get(base[name] + path)
        except httpx.TransportError:
            return None
        return answer.json() if answer.is_success else None

    def up() -> set[str]:
        found = asked("prometheus", "/api/v1/targets")
        targets = found["data"]["activeTargets"] if found else []
        return {target["labels"]["job"] for target in targets if target["health"] == "up"}

    until(lambda: up() == {"heliotwin", "heliotwin-worker"}, "service and worker are watched")
    rules = asked("prometheus", "/api/v1/rules")["data"]["groups"]
    declared = (
        (monitored.folder / "prometheus-rules.yml").read_text(encoding="utf-8").count("alert:")
    )
    health = [rule["health"] for group in rules for rule in group["rules"]]
    assert len(health) == declared
    assert set(health) <= {"ok", "unknown"}
    until(
        lambda: asked("prometheus", "/api/v1/alertmanagers")["data"]["activeAlertmanagers"],
        "alerts have a way",
    )

    # Written in place: both files are mounted.
    rules_file, configuration = (
        monitored.folder / name for name in ("prometheus-rules.yml", "prometheus.yml")
    )
    patient, seldom = (path.read_text(encoding="utf-8") for path in (rules_file, configuration))
    often = "scrape_interval: 5s\n  scrape_timeout: 5s\n  evaluation_interval: 1s"
    assert "scrape_interval: 15s" in seldom
    try:
        rules_file.write_text(re.sub(r"for: \d+[mh]", "for: 0s", patient), encoding="utf-8")
        configuration.write_text(seldom.replace("scrape_interval: 15s", often), encoding="utf-8")
        monitored("kill", "-s", "HUP", "prometheus")
        monitored("stop", "service")
        until(
            lambda: (
                "HeliotwinDown"
                in {
                    one["labels"]["alertname"]
                    for one in asked("alertmanager", "/api/v2/alerts") or ()
                }
            ),
            "an alert reports that the service is away",
        )
    finally:
        rules_file.write_text(patient, encoding="utf-8")
        configuration.write_text(seldom, encoding="utf-8")


@pytest.fixture(scope="module")
def plant(checkout: Path, version: str, stj: Path) -> Iterator[Composition]:
    """The composition of this version, for all tests of it; the last of them restores it."""
    with composed(checkout, version, stj) as running:
        yield running


def test_containers_have_bounds_and_few_rights(plant: Composition):
    """What the engine holds each container to, the database among them."""
    for name in ("database", "service", "worker"):
        host = json.loads(plant.inspect(name, "{{json .HostConfig}}"))
        assert host["Memory"] >= 2**30, name
        assert host["NanoCpus"] >= 10**9, name
        assert 0 < host["PidsLimit"] <= 512, name
        assert host["LogConfig"] == {
            "Type": "json-file",
            "Config": {"max-file": "5", "max-size": "10m"},
        }, name
        assert host["ReadonlyRootfs"], name
        assert host["CapDrop"] == ["ALL"], name
        assert host["SecurityOpt"] == ["no-new-privileges:true"], name
    assert json.loads(plant.inspect("database", "{{json .NetworkSettings.Ports}}")) in (
        {},
        {"5432/tcp": None},
    )


_ASK = """
import socket, sys
try:
    socket.create_connection((sys.argv[1], 5432), 5).close()
    print("reached")
except OSError:
    print("out of reach")
"""


def test_database_is_out_of_reach_from_other_containers(plant: Composition, version: str):
    """By name and by address: from the network that prometheus and grafana are in; service and
    worker reach it.
    """
    networks = json.loads(plant.inspect("database", "{{json .NetworkSettings.Networks}}"))
    (address,) = (network["IPAddress"] for network in networks.values())
    assert list(networks) == [f"{plant.project}_database"]
    for network, found in (("default", "out of reach"), ("database", "reached")):
        ask = [
            "docker",
            "run",
            "--rm",
            "--network",
            f"{plant.project}_{network}",
            "--entrypoint",
            "python",
        ]
        for host in ("database", address):
            assert engine.run(*ask, f"heliotwin:{version}", "-c", _ASK, host).strip() == found, (
                network,
                host,
            )


def test_plant_from_empty_to_restored(plant: Composition, stj: Path, backups: Path):
    key = plant.verb("keys", "create", "admin", "--role", "admin").strip()
    with plant.client("wrong") as stranger, pytest.raises(AssertionError, match="401"):
        stranger.get("/v1/heliostats")
    with plant.client(key) as client:
        first, again = imported(client, stj), imported(client, stj)
        assert first["heliostats new"] >= 1
        assert first["images new"] >= 1
        assert again == unchanged(first)
        predicts_and_forecasts(client)
        survives_a_killed_worker(plant, client)
        before = kept(client)
        assert before["AA39"]["measurements"]["items"]
    plant.verb("check")  # ends with 1 where something is lost
    plant.verb("backup", "/backup/today", mounted=backups)
    assert json.loads((backups / "today" / "manifest.json").read_text(encoding="utf-8"))["images"]
    says_nothing_wrong(plant)

    plant.tear_down()
    plant.up("database")
    plant.verb("restore", "/backup/today", mounted=backups)
    plant.up()
    with plant.client(key) as client:
        assert kept(client) == before


def predicts_and_forecasts(client: Client) -> None:
    surface = client.post("/v1/heliostats/AA39/surfaces", {"method": "network"}).json()
    assert surface["version"] >= 1
    sun = {"azimuth_deg": 200, "elevation_deg": 45}
    wanted = {"heliostat": "AA39", "target": "multi_focus_tower", "sun": sun}
    assert client.post("/v1/forecasts", wanted).json()["power_w"] > 1000
    field = {"target": "multi_focus_tower", "sun": sun, "surface": "ideal", "resolution": [64, 64]}
    job = client.done(client.post("/v1/jobs/forecasts", field).headers["Location"])
    assert job["result"]["heliostats"] >= 1


def survives_a_killed_worker(plant: Composition, client: Client) -> None:
    """Killed in the middle of a job, the worker comes back and ends it, and nothing of it is there
    twice.
    """
    before, wanted = (
        versions(client),
        ["AC43", "AA39"],
    )  # the second has many images, and takes long enough
    asked = {"heliostats": wanted, "method": "refined", "images": 8}
    path = client.post("/v1/jobs/predictions", asked).headers["Location"]
    until(lambda: client.job(path).get("progress", 0) > 0, "the job is under way")
    plant("kill", "worker")  # a restart sends SIGTERM first, and a quick worker returns the job
    assert client.job(path)["state"] == "running"
    plant("start", "worker")
    job = client.done(path)
    assert job["attempts"] == 2
    made = {name: count - before[name] for name, count in versions(client).items()}
    assert made == {name: int(name in wanted) for name in before}
    assert sorted(job["result"]["surfaces"]) == sorted(wanted)


def says_nothing_wrong(plant: Composition) -> None:
    """No traceback and nothing about telemetry in the logs; of the schema one line for
    each start.
    """
    for name in ("service", "worker"):
        log = plant("logs", "--no-color", name)
        assert "Traceback" not in log
        assert "telemetry" not in log
        assert 1 <= log.count("schema") <= 2
