"""Waiting for conditions, and processes that end with the test that started them.

No test may fail because the machine is slow. So a test waits for a condition and not for a time,
and each limit here is far beyond what a busy machine takes: it only ends a test that hangs.
"""

import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

WAIT_LIMIT_S = 300.0
"""Time after which a condition is taken not to come true any more [s]."""


def until(
    condition: Callable[[], Any], what: str = "the condition", limit_s: float = WAIT_LIMIT_S
) -> Any:
    """Wait until ``condition`` gives a true value, and return that value."""
    end = time.monotonic() + limit_s
    while not (found := condition()):
        assert time.monotonic() < end, f"{what}: it does not happen"
        time.sleep(0.02)
    return found


@contextmanager
def child_process(command: Sequence[str | Path], **options: Any) -> Iterator[subprocess.Popen[Any]]:
    """A process that is killed at the end, where it still runs, and waited for; its pipes are
    closed.
    """
    with subprocess.Popen(command, **options) as process:
        try:
            yield process
        finally:
            process.kill()
