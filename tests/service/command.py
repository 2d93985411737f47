"""The command ``heliotwin`` in this process, which has loaded its libraries already.

A separate process takes seconds to load them. Tests of starting, listening and signals use
`heliotwin_process`, a copy of a process that has loaded them.
"""

import os
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, redirect_stderr, redirect_stdout
from io import StringIO
from multiprocessing.connection import Client, Listener
from pathlib import Path
from subprocess import CompletedProcess
from tempfile import TemporaryDirectory

import pytest

from heliotwin.cli.main import main
from tests.forked import ForkedProcess, Output, forked_process


def heliotwin(*arguments: object, cwd: Path | None = None) -> CompletedProcess[str]:
    """Run the command as a user does, on a machine where others may read what is not private.

    Returns its exit code and what it said.
    """
    command = ["heliotwin", *map(str, arguments)]
    output, errors, mask = StringIO(), StringIO(), os.umask(0o022)
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(output), redirect_stderr(errors):
        patch.setattr(sys, "argv", command)
        if cwd is not None:
            patch.chdir(cwd)
        try:
            main()
            code: str | int | None = 0
        except SystemExit as ended:
            code = ended.code
        finally:
            os.umask(mask)  # verbs on a store set their own
    return CompletedProcess(command, int(code or 0), output.getvalue(), errors.getvalue())


def exit_code(*arguments: str) -> int:
    """Run the command, and leave what it says to the test's own capture."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["heliotwin", *arguments])
        with pytest.raises(SystemExit) as ended:
            main()
    return int(ended.value.code or 0)


def heliotwin_on(data: Path, *arguments: object, **settings: str) -> CompletedProcess[str]:
    """Run the command on the store in ``data``, with no settings but these."""
    with pytest.MonkeyPatch.context() as patch:
        for name in list(os.environ):
            if name.startswith("HELIOTWIN_"):
                patch.delenv(name)
        for name, value in ({"HELIOTWIN_DATA_DIR": str(data)} | settings).items():
            patch.setenv(name, value)
        return heliotwin(*arguments, cwd=data.parent)


def _call_main(folder: str, *arguments: str) -> None:
    os.chdir(folder)
    sys.argv = ["heliotwin", *arguments]
    main()


def heliotwin_process(
    folder: Path, *arguments: object, **settings: str
) -> AbstractContextManager[ForkedProcess]:
    """The command in a separate process in ``folder``, with no settings but these.

    It writes to the files ``stdout`` and ``stderr`` there.
    """
    environment = {
        name: value for name, value in os.environ.items() if not name.startswith("HELIOTWIN_")
    }
    return forked_process(
        _call_main,
        environment | settings,
        str(folder),
        *map(str, arguments),
        output=Output(folder / "stdout", folder / "stderr"),
    )


_PROGRAM = """#!{python} -SE
import os, sys
from multiprocessing.connection import Client

with Client({address!r}) as tests:
    tests.send((os.getcwd(), dict(os.environ), sys.argv[1:]))
    code, output, errors = tests.recv()
sys.stdout.buffer.write(output)
sys.stderr.buffer.write(errors)
sys.exit(code)
"""


@contextmanager
def heliotwin_program(file: Path) -> Iterator[None]:
    """The command as a program for scripts, in ``file``.

    Each run is a separate process as that of `heliotwin_process`.
    """
    with Listener() as listener:
        file.write_text(_PROGRAM.format(python=sys.executable, address=listener.address))
        file.chmod(0o755)
        answering = threading.Thread(target=_answer, args=(listener,))
        answering.start()
        try:
            yield
        finally:
            with Client(listener.address) as end:
                end.send(None)
            answering.join()


def _answer(listener: Listener) -> None:
    while True:
        with listener.accept() as program:
            asked = program.recv()
            if asked is None:
                return
            program.send(_run(*asked))


def _run(
    folder: str, environment: Mapping[str, str], arguments: Sequence[str]
) -> tuple[int, bytes, bytes]:
    with TemporaryDirectory() as said:
        files = Path(said, "stdout"), Path(said, "stderr")
        with forked_process(
            _call_main, environment, folder, *arguments, output=Output(*files)
        ) as process:
            code = process.wait()
        return code, files[0].read_bytes(), files[1].read_bytes()


def ends(done: CompletedProcess[str], code: int, says: str) -> None:
    """The command ended with this code and one line that says this."""
    assert done.returncode == code, done.stderr
    assert says in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1, done.stderr
