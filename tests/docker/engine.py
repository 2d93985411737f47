"""A container engine, where there is one: images of this checkout, and compositions that leave
nothing behind.
"""

import json
import os
import shutil
import subprocess
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest

from tests.service.conftest import free_port
from tests.waiting import WAIT_LIMIT_S, until

ROOT = Path(__file__).parents[2]

# As the official images start: their program, its configuration, where it keeps what it knows, and
# as whom.
_MONITOR = """
FROM python:3.11-slim
COPY program /bin/{name}
COPY share /usr/share/prometheus
RUN mkdir -p /{name} && chown 65534:65534 /{name}
USER 65534
VOLUME /{name}
ENTRYPOINT ["/bin/{name}", "--config.file=/etc/{name}/{name}.yml", "--storage.{kind}=/{name}"]
"""


def absent() -> str | None:
    """Why no composition can run here; None where it can."""
    if shutil.which("docker") is None:
        return "no container engine: there is no docker"
    asked = subprocess.run(["docker", "info"], capture_output=True, text=True, check=False)
    if asked.returncode:
        return (
            f"no container engine: docker info says {asked.stderr.strip() or asked.stdout.strip()}"
        )
    return (
        None
        if _compose_is_new() or shutil.which("docker-compose")
        else "neither docker compose nor docker-compose"
    )


def _compose_is_new() -> bool:
    return (
        subprocess.run(
            ["docker", "compose", "version"], capture_output=True, check=False
        ).returncode
        == 0
    )


def run(
    *command: str | Path, folder: Path = ROOT, environment: Mapping[str, str] | None = None
) -> str:
    """What a command prints; where it fails, the test fails with all that it said."""
    settings = os.environ | (environment or {})
    done = subprocess.run(
        command, cwd=folder, env=settings, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, (
        f"{command} ended with {done.returncode}:\n{done.stdout[-4000:]}\n{done.stderr[-4000:]}"
    )
    return done.stdout


def clone(folder: Path) -> Path:
    """A clean clone of this checkout, with what is changed in it and not yet committed."""
    run("git", "clone", "--quiet", ROOT, folder)
    for name in run("git", "ls-files", "-z", "--modified", "--others", "--exclude-standard").split(
        "\0"
    ):
        if name and (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / name)
    for name in run("git", "ls-files", "-z", "--deleted").split("\0"):
        if name:
            (folder / name).unlink()
    return folder


def stand_in_index() -> str:
    """Where a stand-in for the base image has torch's wheel; nothing where the image is the
    official one.
    """
    ask = ["docker", "run", "--rm", "--entrypoint", "ls", "python:3.11-slim", "/wheels"]
    done = subprocess.run(ask, capture_output=True, text=True, check=False)
    return "file:///wheels" if "+cpu" in done.stdout else ""


def build(context: Path, dockerfile: Path, image: str, stage: str = "") -> str:
    """Build an image, or one of its stages, with the builder that every engine has."""
    index = os.environ.get("TORCH_INDEX_URL", "") or stand_in_index()
    arguments = ["--build-arg", f"TORCH_INDEX_URL={index}"] if index else []
    command = [
        "docker",
        "build",
        "--quiet",
        "--network",
        "host",
        *arguments,
        *(["--target", stage] if stage else []),
        "-f",
        str(dockerfile),
        "-t",
        image,
    ]
    run(*command, str(context), environment={"DOCKER_BUILDKIT": "0"})
    return image


def build_heliotwin(checkout: Path, image: str) -> str:
    """Build this project's image.

    The layers with the packages of others stay in the engine, under a separate tag. As long as
    the locked versions stay, the next build finds them there.
    """
    dockerfile = checkout / "docker" / "Dockerfile"
    build(checkout, dockerfile, "heliotwin-test:packages", stage="packages")
    return build(checkout, dockerfile, image)


def build_monitor(program: str, name: str, kind: str, folder: Path, image: str) -> str:
    """A stand-in for an official image, ``prometheus`` or ``alertmanager``, with this machine's
    program of a Debian.
    """
    folder.mkdir()
    shutil.copy2(program, folder / "program")
    shutil.copytree("/usr/share/prometheus", folder / "share")  # a Debian's has its templates there
    dockerfile = folder / "Dockerfile"
    dockerfile.write_text(_MONITOR.format(name=name, kind=kind), encoding="utf-8")
    return build(folder, dockerfile, image)


class Composition:
    """docker/compose.yaml of a clone, with a separate project name and port.

    ``version`` is the image's tag.
    """

    def __init__(self, checkout: Path, version: str, imports: Path) -> None:
        self.project = f"heliotwin-test-{uuid.uuid4().hex[:8]}"
        self.folder = checkout / "docker"
        self.port = free_port()
        password = self.folder / "secrets" / f"{self.project}-password"
        password.parent.mkdir(exist_ok=True)
        password.write_text(uuid.uuid4().hex, encoding="utf-8")
        password.chmod(0o644)
        self.environment = {
            "HELIOTWIN_VERSION": version,
            "HELIOTWIN_PUBLISHED_PORT": str(self.port),
            "HELIOTWIN_PASSWORD_FILE": str(password),
            "HELIOTWIN_IMPORT_FOLDER": str(imports),
            "HELIOTWIN_PROMETHEUS_PORT": str(free_port()),
            "HELIOTWIN_ALERTMANAGER_PORT": str(free_port()),
        }
        self._command = self._of_this_engine()
        # Each check starts a Python: once a second they would take most of a core.
        frequent = {"healthcheck": {"interval": "4s"}}
        self._override("health", dict.fromkeys(("database", "service", "worker"), frequent))

    def _of_this_engine(self) -> list[str]:
        if _compose_is_new():
            return [
                "docker",
                "compose",
                "-p",
                self.project,
                "-f",
                str(self.folder / "compose.yaml"),
            ]
        # docker-compose 1.29 takes no name in the file and wants a version; all else of it it
        # understands.
        lines = (self.folder / "compose.yaml").read_text(encoding="utf-8").splitlines()
        old = self.folder / f".{self.project}.yaml"
        old.write_text(
            "\n".join(['version: "3.9"', *(line for line in lines if not line.startswith("name:"))])
        )
        return ["docker-compose", "-p", self.project, "-f", str(old)]

    def __call__(self, *arguments: str) -> str:
        """What a command of compose prints."""
        return run(
            *self._command, *arguments, folder=self.folder.parent, environment=self.environment
        )

    def instead(self, images: Mapping[str, str]) -> None:
        """Start services from other images than the file names."""
        self._override("images", {name: {"image": image} for name, image in images.items()})

    def _override(self, what: str, services: Mapping[str, Mapping[str, Any]]) -> None:
        """Change some fields of services."""
        file = self.folder / f".{self.project}-{what}.yaml"
        file.write_text(json.dumps({"version": "3.9", "services": services}), encoding="utf-8")
        self._command += ["-f", str(file)]

    def verb(self, *words: str, mounted: Path | None = None) -> str:
        """Output of ``heliotwin WORDS`` in a separate container; ``mounted`` is its /backup."""
        volume = [] if mounted is None else ["-v", f"{mounted}:/backup"]
        return self("run", "--rm", "--no-deps", "-T", *volume, "service", *words)

    def up(self, *services: str) -> None:
        """Start, and wait until all is well."""
        self("up", "-d", *services)
        for name in services or ("database", "service", "worker"):
            until(lambda name=name: self.health(name) == "healthy", f"{name} is healthy")

    def health(self, name: str) -> str:
        """What the health check of a service's container says."""
        return self.inspect(name, "{{.State.Health.Status}}")

    def inspect(self, name: str, what: str) -> str:
        """What the engine knows of a service's container."""
        return run("docker", "inspect", "--format", what, self("ps", "-q", name).strip()).strip()

    def tear_down(self) -> None:
        """Remove its containers, networks and volumes."""
        self("down", "-v", "--remove-orphans", "--timeout", "5")

    @contextmanager
    def client(self, key: str) -> Iterator["Client"]:
        """Somebody with a key."""
        headers = {"Authorization": f"Bearer {key}"}
        with httpx.Client(
            base_url=f"http://127.0.0.1:{self.port}", headers=headers, timeout=WAIT_LIMIT_S
        ) as http:
            # The engine may break connections from outside while another container comes or goes.
            until(lambda: _answers(http), "the published port answers")
            yield Client(http)


def _answers(http: httpx.Client) -> bool:
    try:
        return http.get("/livez").is_success
    except httpx.TransportError:
        return False


class Client:
    """What a plant asks of its service."""

    def __init__(self, http: httpx.Client) -> None:
        self._http = http

    def get(self, path: str) -> Any:
        """The document of a resource."""
        answer = self._http.get(path)
        assert answer.status_code == 200, (path, answer.status_code, answer.text)
        return answer.json()

    def post(self, path: str, document: dict[str, Any]) -> httpx.Response:
        """The answer to a document that is welcome."""
        answer = self._http.post(path, json=document)
        assert answer.is_success, (path, answer.status_code, answer.text)
        return answer

    def job(self, path: str) -> dict[str, Any]:
        """The current state of a job, "unknown" while the service is away."""
        try:
            document: dict[str, Any] = self.get(path)
        except httpx.TransportError:
            return {"state": "unknown"}
        return document

    def done(self, path: str) -> dict[str, Any]:
        """A job when it is done."""
        ended = until(
            lambda: (
                (job := self.job(path))["state"] not in ("unknown", "queued", "running") and job
            ),
            path,
            3 * WAIT_LIMIT_S,
        )
        assert ended["state"] == "done", json.dumps(ended, indent=1)
        return dict(ended)


def binary(*names: str) -> str:
    """The first of these programs that there is; skips the test where there is none."""
    path = os.environ.get("HELIOTWIN_TEST_PROMETHEUS", os.environ["PATH"])
    found = next((place for name in names if (place := shutil.which(name, path=path))), None)
    if found is None:
        pytest.skip(f"no {names[0]}: apt-get install prometheus prometheus-alertmanager")
    return found
