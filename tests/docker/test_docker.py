"""The container's files, as far as they can be tried without an engine."""

import http.server
import json
import os
import re
import shutil
import subprocess
import sys
import threading
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from fnmatch import fnmatch
from importlib.metadata import distribution
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jsonschema
import pytest
import yaml
from alembic.script import ScriptDirectory
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import heliotwin
from service.base.settings import Settings
from service.store.database import alembic_config
from service.twin.alarms.field_overview import FieldOverviewCache
from service.twin.alarms.reasons import REASONS
from service.twin.runtime import Runtime
from service.web.store_metrics import registry
from tests.docker.files import DOCKER, ROOT, SECRET, drawn_expressions


@pytest.fixture(scope="module")
def dockerfile() -> list[tuple[str, str]]:
    """Instructions of the Dockerfile with their arguments, continued lines joined."""
    text = (DOCKER / "Dockerfile").read_text(encoding="utf-8").replace("\\\n", " ")
    lines = [line for line in text.splitlines() if line and not line.startswith("#")]
    return [(line.split(maxsplit=1)[0], " ".join(line.split()[1:])) for line in lines]


# --- compose.yaml
# --------------------------------------------------------------------------------------------------


def test_compose_file_fits_the_published_schema(compose: dict[str, Any]):
    schema = json.loads((Path(__file__).parent / "compose-spec.json").read_text(encoding="utf-8"))
    jsonschema.Draft202012Validator(schema).validate(compose)


def test_services_start_in_order(compose: dict[str, Any]):
    services = compose["services"]
    assert services["migrate"]["depends_on"] == {"database": {"condition": "service_healthy"}}
    assert services["service"]["depends_on"]["migrate"] == {
        "condition": "service_completed_successfully"
    }
    assert services["migrate"]["restart"] == "no"
    for name in ("database", "service"):
        assert "test" in services[name]["healthcheck"]


def test_what_compose_names_exists(compose: dict[str, Any]):
    for service in compose["services"].values():
        for volume in service.get("volumes", []):
            source = volume.split(":")[0]
            assert source in compose["volumes"] or source.startswith("./")
            assert Path(source).suffix != ".yml" or (DOCKER / source).is_file()
        assert set(service.get("secrets", [])) <= set(compose["secrets"])
        if "build" in service:
            assert (DOCKER / service["build"]["context"] / service["build"]["dockerfile"]).is_file()


def test_no_secret_is_in_the_file(compose: dict[str, Any]):
    for service in compose["services"].values():
        for key, value in service.get("environment", {}).items():
            assert not ("PASSWORD" in key and not key.endswith("_FILE")), key
            assert not re.search(r"://[^/@]*:[^/@]*@", value), value
    assert "secrets/" in (DOCKER / ".gitignore").read_text(encoding="utf-8")


def test_containers_have_no_more_rights_than_they_need(compose: dict[str, Any]):
    for name, service in compose["services"].items():
        assert service["read_only"] is True, name
        assert service["cap_drop"] == ["ALL"], name
        assert service["security_opt"] == ["no-new-privileges:true"], name
        assert "cap_add" not in service or name == "database"
    published = [
        port for service in compose["services"].values() for port in service.get("ports", [])
    ]
    assert len(published) == 4
    assert all(port.startswith("127.0.0.1:") for port in published)


def test_each_container_has_its_bounds(compose: dict[str, Any]):
    for name, service in compose["services"].items():
        assert re.fullmatch(r"\d+[mg]", service["mem_limit"]), name
        assert 0 < service["cpus"] <= 2, name
        assert 0 < service["pids_limit"] <= 512, name
        assert service["logging"] == {
            "driver": "json-file",
            "options": {"max-size": "10m", "max-file": "5"},
        }, name


def test_database_has_a_network_for_those_that_use_it(compose: dict[str, Any]):
    assert compose["networks"] == {"database": {"internal": True}}
    networks = {
        name: service.get("networks", ["default"]) for name, service in compose["services"].items()
    }
    assert networks["database"] == networks["migrate"] == ["database"]
    assert networks["service"] == networks["worker"] == ["default", "database"]
    assert all(networks[name] == ["default"] for name in ("prometheus", "alertmanager", "grafana"))
    assert "ports" not in compose["services"]["database"]


_DOCKER_STAND_IN = """#!/bin/sh
[ "$1" = pull ] && exit
for image; do :; done
echo "${image%%:*}@sha256:$(printf %s "$image" | sha256sum | cut -c1-64)"
"""


def test_images_are_named_by_digest_once_they_are_pinned(tmp_path: Path):
    """The script that the administrator's guide names, with an engine that knows a digest of every
    image; compose reads its file.
    """
    for name in ("pin_images.sh", "compose.yaml"):
        shutil.copy(DOCKER / name, tmp_path)
    (tmp_path / ".env").write_text(
        "HELIOTWIN_CPUS=1\nHELIOTWIN_POSTGRES_IMAGE=old\n", encoding="utf-8"
    )
    program = tmp_path / "bin" / "docker"
    program.parent.mkdir()
    program.write_text(_DOCKER_STAND_IN, encoding="utf-8")
    program.chmod(0o755)
    path = f"{program.parent}{os.pathsep}{os.environ['PATH']}"
    subprocess.run(
        ["bash", tmp_path / "pin_images.sh"], env=os.environ | {"PATH": path}, check=True
    )
    written = dict(
        line.split("=", 1) for line in (tmp_path / ".env").read_text(encoding="utf-8").splitlines()
    )
    assert written.pop("HELIOTWIN_CPUS") == "1"
    named = re.findall(
        r"\$\{(HELIOTWIN_\w+_IMAGE):-([^}]+)\}",
        (DOCKER / "compose.yaml").read_text(encoding="utf-8"),
    )
    assert written.keys() == {variable for variable, _ in named}
    for variable, image in named:
        assert re.fullmatch(
            re.escape(image.partition(":")[0]) + "@sha256:[0-9a-f]{64}", written[variable]
        )


def test_every_image_of_others_can_be_pinned(dockerfile: list[tuple[str, str]]):
    """None is named but as the value of a variable, in the file of the composition and in the
    Dockerfile.
    """
    document = yaml.safe_load((DOCKER / "compose.yaml").read_text(encoding="utf-8"))
    own = f"heliotwin:${{HELIOTWIN_VERSION:-{heliotwin.__version__}}}"
    images = {service["image"] for service in document["services"].values()} - {own}
    images.add(document["x-service"]["build"]["args"]["PYTHON_IMAGE"])
    assert len(images) == 5
    assert all(re.fullmatch(r"\$\{HELIOTWIN_\w+_IMAGE:-[\w/.:-]+\}", image) for image in images)
    bases = [arguments.split()[0] for name, arguments in dockerfile if name == "FROM"]
    assert set(bases) == {"${PYTHON_IMAGE}", "dependencies", "packages"}


def test_environment_makes_valid_settings(
    compose: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    secret = tmp_path / "database_password"
    secret.write_text("p@ss:word\n", encoding="utf-8")
    for name in ("migrate", "service", "worker"):
        for key, value in compose["services"][name]["environment"].items():
            monkeypatch.setenv(key, value.replace(SECRET, str(secret)))
        settings = Settings(_env_file=None)  # type: ignore[call-arg]  # pydantic-settings' own argument
        assert settings.database.drivername == "postgresql+psycopg"
        assert settings.database.password == "p@ss:word"
        assert not settings.migrates_on_start
        for key in compose["services"][name]["environment"]:
            monkeypatch.delenv(key)


def test_jobs_are_worked_at_by_the_worker_alone(compose: dict[str, Any]):
    """The worker sees the images that the service stores, and reads the folders that it
    may import.
    """
    service, worker = compose["services"]["service"], compose["services"]["worker"]
    assert service["environment"]["HELIOTWIN_JOB_WORKERS"] == "0"
    assert "HELIOTWIN_JOB_WORKERS" not in worker["environment"]
    assert worker["command"] == ["worker"]
    assert set(service["volumes"]) < set(worker["volumes"])
    (imports,) = set(worker["volumes"]) - set(service["volumes"])
    assert imports.endswith(f":{worker['environment']['HELIOTWIN_IMPORT_ROOT']}:ro")
    assert worker["depends_on"] == service["depends_on"]


# --- Prometheus
# --------------------------------------------------------------------------------------------------


def test_prometheus_reads_the_addresses_of_the_services(compose: dict[str, Any]):
    scraped = yaml.safe_load((DOCKER / "prometheus.yml").read_text(encoding="utf-8"))[
        "scrape_configs"
    ]
    targets = {
        target
        for job in scraped
        for static in job.get("static_configs", [])
        for target in static["targets"]
    }
    found = [entry for job in scraped for entry in job.get("dns_sd_configs", [])]
    targets |= {f"{name}:{entry['port']}" for entry in found for name in entry["names"]}
    assert targets == {f"{name}:9100" for name in ("service", "worker")}
    for name in ("service", "worker"):
        assert compose["services"][name]["environment"]["HELIOTWIN_METRICS_PORT"] == "9100"
    assert compose["services"]["prometheus"]["profiles"] == ["monitoring"]


def test_prometheus_sends_alerts_to_alertmanager(compose: dict[str, Any]):
    alerting = yaml.safe_load((DOCKER / "prometheus.yml").read_text(encoding="utf-8"))["alerting"]
    assert alerting == {"alertmanagers": [{"static_configs": [{"targets": ["alertmanager:9093"]}]}]}
    alertmanager = compose["services"]["alertmanager"]
    assert alertmanager["profiles"] == ["monitoring"]
    assert "./alertmanager.yml:/etc/alertmanager/alertmanager.yml:ro" in alertmanager["volumes"]


def test_grafana_draws_what_prometheus_has(compose: dict[str, Any]):
    grafana = compose["services"]["grafana"]
    assert grafana["profiles"] == ["monitoring"]
    sources = [mount.split(":")[0] for mount in grafana["volumes"] if mount.startswith("./")]
    assert all((DOCKER / source).is_file() for source in sources)
    (source,) = yaml.safe_load((DOCKER / "grafana" / "datasource.yml").read_text(encoding="utf-8"))[
        "datasources"
    ]
    assert source["url"] == "http://prometheus:9090"
    dashboard = json.loads((DOCKER / "grafana" / "heliotwin.json").read_text(encoding="utf-8"))
    cells = [
        (x, y)
        for place in (panel["gridPos"] for panel in dashboard["panels"])
        for x in range(place["x"], place["x"] + place["w"])
        for y in range(place["y"], place["y"] + place["h"])
    ]
    assert len(cells) == len(set(cells))
    assert max(x for x, _ in cells) < 24
    assert {panel["datasource"]["uid"] for panel in dashboard["panels"]} == {source["uid"]}
    assert len({panel["id"] for panel in dashboard["panels"]}) == len(dashboard["panels"])


def _rules() -> list[dict[str, Any]]:
    groups = yaml.safe_load((DOCKER / "prometheus-rules.yml").read_text(encoding="utf-8"))["groups"]
    return [rule for group in groups for rule in group["rules"]]


def test_rules_are_well_formed():
    """What promtool checks too, in `test_alerts.py`, where it is to be had."""
    rules = _rules()
    assert len({rule["alert"] for rule in rules}) == len(rules)
    for rule in rules:
        assert (
            {"alert", "expr", "annotations"}
            <= set(rule)
            <= {"alert", "expr", "for", "labels", "annotations"}
        )
        assert re.fullmatch(r"\d+[smhd]", rule.get("for", "0s"))
        assert rule["annotations"]["summary"]


def test_every_alarm_reason_has_its_alert():
    asked = [
        (reason, rule["labels"]["severity"])
        for rule in _rules()
        for reason in re.findall(r'heliotwin_alarms{reason="(\w+)"', rule["expr"])
    ]
    assert asked == [(reason, str(known.severity)) for reason, known in REASONS.items()]
    assert {rule["labels"]["severity"] for rule in _rules()} == {"1", "2", "3"}


def test_alerts_ask_for_metrics_that_exist(tmp_path: Path):
    runtime = Runtime.from_settings(Settings(data_dir=tmp_path), SimpleNamespace())  # type: ignore[arg-type]
    runtime.database.upgrade()
    names = {family.name for family in registry(runtime, FieldOverviewCache(runtime)).collect()}
    runtime.close()
    names |= {f"{name}_total" for name in names}
    rules = _rules()
    asked = {name for rule in rules for name in re.findall(r"heliotwin_\w+", rule["expr"])}
    assert len(rules) == 5 + len(REASONS)
    assert asked <= names
    drawn = {
        name
        for expression in drawn_expressions()
        for name in re.findall(r"heliotwin_\w+", expression)
    }
    assert {name.removesuffix("_bucket") for name in drawn} <= names
    guide = ROOT / "docs" / "how-to" / "administrator" / "monitor.md"
    documented = set(re.findall(r"heliotwin_\w+", guide.read_text(encoding="utf-8")))
    assert documented <= names


# --- Dockerfile
# --------------------------------------------------------------------------------------------------


def _patterns() -> list[str]:
    lines = (DOCKER / "Dockerfile.dockerignore").read_text(encoding="utf-8").splitlines()
    return [line for line in lines if line and not line.startswith("#")]


def _sources(dockerfile: list[tuple[str, str]]) -> list[str]:
    copies = [arguments.split() for name, arguments in dockerfile if name == "COPY"]
    return [
        source for words in copies if not words[0].startswith("--from") for source in words[:-1]
    ]


def test_sources_exist_and_are_in_the_context(dockerfile: list[tuple[str, str]]):
    for source in _sources(dockerfile):
        assert f"!{source}" in _patterns()
        assert (ROOT / source).exists(), source


def test_image_does_not_run_as_root(dockerfile: list[tuple[str, str]]):
    users = [arguments for name, arguments in dockerfile if name == "USER"]
    assert users == ["heliotwin"]
    assert ("ENTRYPOINT", '["heliotwin"]') in dockerfile
    assert ("CMD", '["serve"]') in dockerfile
    names = [name for name, _ in dockerfile]
    assert names.index("USER") < names.index("ENTRYPOINT")


def _locked(name: str) -> dict[str, tuple[str, int]]:
    """Version and number of hashes of each package in a lock file."""
    parts = re.split(
        r"^(?=[a-z])", (DOCKER / name).read_text(encoding="utf-8"), flags=re.MULTILINE
    )[1:]
    requirements = [
        (Requirement(part.split(maxsplit=1)[0]), part.count("--hash=sha256:")) for part in parts
    ]
    return {
        found.name: (str(found.specifier).removeprefix("=="), hashes)
        for found, hashes in requirements
    }


def _needed(*extras: str) -> set[str]:
    """What is installed here because heliotwin with these extras needs it, at any remove."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    lines = [*project["dependencies"]]
    lines += [line for extra in extras for line in project["optional-dependencies"][extra]]
    asked, found = [(Requirement(text), {""}) for text in lines], set[str]()
    while asked:
        requirement, given = asked.pop()
        marker, name = requirement.marker, canonicalize_name(requirement.name)
        if marker is not None and not any(marker.evaluate({"extra": extra}) for extra in given):
            continue
        if name not in found or requirement.extras:
            found.add(name)
            asked += [
                (Requirement(text), requirement.extras or {""})
                for text in distribution(name).requires or ()
            ]
    return found


def test_locks_hold_what_the_service_needs_in_the_versions_of_the_constraints():
    """All that is installed for heliotwin here, in the same versions; each with the hashes of its
    files.
    """
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    constrained = {
        canonicalize_name(line.split("==")[0]): line.split("==")[1]
        for line in lines
        if "==" in line
    }
    everywhere, cpu, gpu, docs = (
        _locked(f"requirements{kind}.lock") for kind in ("", "-cpu", "-gpu", "-docs")
    )
    assert set(everywhere) | set(cpu) == _needed()
    for name, (version, _) in (everywhere | gpu | docs).items():
        assert version == constrained.get(name, version), name
    assert set(everywhere) - set(constrained) == {"setuptools"}  # which pip freeze leaves out
    assert {name: version for name, (version, _) in cpu.items()} == {
        "torch": f"{constrained['torch']}+cpu"
    }
    assert {"torch", "nvidia-cudnn-cu13", "triton"} <= set(gpu)
    assert not set(everywhere) & (set(cpu) | set(gpu) | set(docs))
    assert set(everywhere) | set(cpu) | set(docs) == _needed("docs")
    assert all(hashes >= 1 for lock in (everywhere, cpu, gpu, docs) for _, hashes in lock.values())


def test_nothing_is_installed_but_by_its_hash(dockerfile: list[tuple[str, str]]):
    text = " ".join(arguments for name, arguments in dockerfile if name == "RUN")
    runtime, docs, *others = re.findall(r"pip (?:install|wheel) ([^&]*?)(?= /opt|&|$)", text)
    assert all(words.startswith("--no-deps --require-hashes ") for words in (runtime, docs))
    assert re.findall(r'-r "?([^ "]+)', f"{runtime} {docs}") == [
        "requirements.lock",
        "requirements-${torch:-gpu}.lock",
        "requirements-docs.lock",
    ]
    assert len(others) == 2
    assert all("--no-index" in words and "--no-deps" in words for words in others)


def test_no_package_index_is_named():
    for path in DOCKER.iterdir():
        if path.is_file():
            assert not re.search(r"https?://(?!127\.0\.0\.1)", path.read_text(encoding="utf-8")), (
                path
            )


# --- health checks
# --------------------------------------------------------------------------------------------------


@contextmanager
def _answering(status: int) -> Iterator[int]:
    """A server on this machine that answers everything with ``status``; yields its port."""

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(status)
            self.end_headers()

        def log_message(self, *_: Any) -> None:
            pass

    with http.server.HTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield server.server_address[1]
        server.shutdown()
        thread.join()


def _of_image(dockerfile: list[tuple[str, str]], _compose: dict[str, Any]) -> list[str]:
    (arguments,) = [arguments for name, arguments in dockerfile if name == "HEALTHCHECK"]
    command: list[str] = json.loads(arguments.split("CMD ", 1)[1])
    return command


def _of_compose(_dockerfile: list[tuple[str, str]], compose: dict[str, Any]) -> list[str]:
    command: list[str] = compose["services"]["service"]["healthcheck"]["test"][1:]
    return command


def _of_worker(_dockerfile: list[tuple[str, str]], compose: dict[str, Any]) -> list[str]:
    command: list[str] = compose["services"]["worker"]["healthcheck"]["test"][1:]
    return command


@pytest.mark.full
@pytest.mark.parametrize("command_of", [_of_image, _of_compose, _of_worker])
@pytest.mark.parametrize(("status", "is_healthy"), [(200, True), (503, False)])
def test_health_check_command(
    dockerfile: list[tuple[str, str]],
    compose: dict[str, Any],
    command_of: Callable[..., list[str]],
    status: int,
    is_healthy: bool,
):
    program, *arguments = command_of(dockerfile, compose)
    assert program == "python"
    with _answering(status) as port:
        arguments = [re.sub(":(8000|9100)/", f":{port}/", argument) for argument in arguments]
        environment = os.environ | {"HELIOTWIN_PORT": str(port)}
        done = subprocess.run(
            [sys.executable, *arguments], env=environment, capture_output=True, check=False
        )
    assert (done.returncode == 0) is is_healthy


# --- the build by hand
# ------------------------------------------------------------------------------------------------


_TRY = """
import service, pathlib, sys
assert pathlib.Path(service.__file__).is_relative_to(sys.argv[1]), service.__file__
from service.store.database import migrate
from service.web.store_metrics import registry
from service.twin.alarms.field_overview import FieldOverviewCache
from service.twin.alarms.reasons import REASONS
from service.twin.runtime import Runtime
from service.base.settings import Settings
print(migrate(Settings(data_dir=pathlib.Path(sys.argv[2]))))
from model.network.predictor import default_predictor
print(default_predictor().name)
"""


def _ignored(folder: str, names: list[str]) -> list[str]:
    patterns = [pattern.removeprefix("**/") for pattern in _patterns() if pattern.startswith("**/")]
    return [name for name in names if any(fnmatch(name, pattern) for pattern in patterns)]


@pytest.mark.full
def test_installed_copy_brings_migrations_and_weights(
    dockerfile: list[tuple[str, str]], tmp_path: Path
):
    """What the Dockerfile copies is enough to install the service and to run it from anywhere."""
    context, installed = tmp_path / "context", tmp_path / "installed"
    context.mkdir()
    for source in _sources(dockerfile):
        path = ROOT / source
        if path.is_dir():
            shutil.copytree(path, context / source, ignore=_ignored)
        elif path.is_file():
            (context / source).parent.mkdir(exist_ok=True)
            shutil.copy(path, context / source)
    pip = [
        sys.executable,
        "-m",
        "pip",
        "install",
        "--quiet",
        "--no-deps",
        "--no-build-isolation",
        "--no-index",
    ]
    subprocess.run(
        [*pip, "--target", str(installed), str(context)], check=True, capture_output=True
    )
    environment = os.environ | {"PYTHONPATH": str(installed)}
    command = [sys.executable, "-c", _TRY, str(installed), str(tmp_path / "data")]
    done = subprocess.run(
        command, cwd=tmp_path, env=environment, check=True, capture_output=True, text=True
    )
    revision, weights = done.stdout.split()
    assert revision == ScriptDirectory.from_config(alembic_config()).get_current_head()
    assert (installed / "service" / "web" / "root" / "guide" / "index.html").is_file()
    assert weights.startswith("surface-network-")
