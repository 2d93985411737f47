"""The command ``heliotwin`` in this process, which has loaded its libraries already.

A separate process takes seconds to load them. Tests of starting, listening and signals use
`heliotwin_process`, a copy of a process that has loaded them.
"""

import os
import sys
from contextlib import AbstractContextManager, redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from subprocess import CompletedProcess

import pytest

from service.cli.main import main
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


def ends(done: CompletedProcess[str], code: int, says: str) -> None:
    """The command ended with this code and one line that says this."""
    assert done.returncode == code, done.stderr
    assert says in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1, done.stderr
