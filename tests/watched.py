"""Commands whose connections are watched at the kernel's door, below all libraries."""

import re
import shutil
import subprocess
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]
CALLS = "connect,sendto,sendmsg,sendmmsg"


class NotWatchedError(Exception):
    """No process can be watched here; the message says why."""


def watching(record: Path) -> list[str]:
    """What a command begins with whose connections are written to ``record``, and refused.

    Raises NotWatchedError where no process can be watched.
    """
    watch = _watch()
    _try(watch)
    return [*watch, "-o", str(record)]


def _watch() -> tuple[str, ...]:
    program = shutil.which("strace")
    if program is None:
        raise NotWatchedError("strace is not installed: apt-get install strace")
    # The filter stops a process at these calls only, and not at every one.
    watch = [program, "-f", "--seccomp-bpf", "-qq", "-e", "signal=none"]
    return (*watch, "-e", f"trace={CALLS}", "-e", "inject=connect:error=ENETUNREACH")


@cache
def _try(watch: tuple[str, ...]) -> None:
    asked = subprocess.run(
        [*watch, "-o", "/dev/null", "true"], capture_output=True, text=True, check=False
    )
    if asked.returncode:
        raise NotWatchedError(f"this machine lets nobody watch a process: {asked.stderr.strip()}")


def opened(record: Path) -> list[str]:
    """The connections that were tried; those of one machine's processes with each other
    are none.
    """
    lines = record.read_text(encoding="utf-8").splitlines()
    return [
        line for line in lines if re.search(r"sa_family=(?!AF_UNIX|AF_NETLINK|AF_UNSPEC)", line)
    ]


def environment(folder: Path, **more: str) -> dict[str, str]:
    """That of a machine where nothing is set, not even that it is one for tests; some libraries
    mind those.
    """
    places = {"HOME": str(folder / "home"), "PATH": "/usr/bin:/bin", "PYTHONPATH": str(ROOT)}
    return places | {"HELIOTWIN_DATA_DIR": str(folder / "data"), "OMP_NUM_THREADS": "1"} | more
