"""Processes that begin as copies of one that has loaded the service's libraries.

A separate process takes seconds to load them. The copies are made by a server of the standard
library, which does nothing else: no thread runs in it when it is copied.
"""

import multiprocessing
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path

import pytest
from coverage import Coverage

_ROOT = Path(__file__).parents[1]
_CONTEXT = multiprocessing.get_context("forkserver")
_CONTEXT.set_forkserver_preload(["tests.preloaded"])


@dataclass(frozen=True)
class Output:
    """The files that a process writes its output and its errors to; by default it writes none."""

    stdout: Path | None = None
    stderr: Path = Path(os.devnull)

    def redirect(self) -> None:
        """Let this process write there from now on."""
        for number, path in ((1, self.stdout), (2, self.stderr)):
            if path is not None:
                with path.open("ab") as file:
                    os.dup2(file.fileno(), number)


def _run(
    target: Callable[..., None],
    environment: dict[str, str],
    output: Output,
    is_measured: bool,
    *arguments: str,
) -> None:
    os.environ.clear()
    os.environ.update(environment)
    output.redirect()
    with _measured() if is_measured else nullcontext():
        target(*arguments)


@contextmanager
def _measured() -> Iterator[None]:
    """Coverage of this process, with the test that started it as its context."""
    coverage = Coverage(_ROOT / ".coverage", config_file=str(_ROOT / "pyproject.toml"))
    coverage.start()
    try:
        yield
    finally:
        coverage.stop()
        coverage.save()


class ForkedProcess:
    """The part of `subprocess.Popen` that tests need."""

    def __init__(
        self,
        target: Callable[..., None],
        environment: Mapping[str, str],
        *arguments: str,
        output: Output,
    ) -> None:
        is_measured = Coverage.current() is not None
        given = (target, dict(environment), output, is_measured, *arguments)
        self._process = _CONTEXT.Process(target=_run, args=given)
        with pytest.MonkeyPatch.context() as patch:  # the server of copies is not measured
            patch.delenv("COVERAGE_PROCESS_START", raising=False)
            self._process.start()
        assert self._process.pid is not None
        self.pid: int = self._process.pid
        self.returncode: int | None = None

    def poll(self) -> int | None:
        self.returncode = self._process.exitcode
        return self.returncode

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            os.kill(self.pid, number)

    def wait(self, timeout: float | None = None) -> int:
        self._process.join(timeout)
        code = self.poll()
        assert code is not None, "the process does not end"
        return code


@contextmanager
def forked_process(
    target: Callable[..., None],
    environment: Mapping[str, str],
    *arguments: str,
    output: Output = Output(),  # immutable
) -> Iterator[ForkedProcess]:
    """A process that calls ``target``; killed at the end, where it still runs, and waited for."""
    process = ForkedProcess(target, environment, *arguments, output=output)
    try:
        yield process
    finally:
        process._process.kill()
        process.wait()
