"""Processes of the service: their threads, their memory, and locks between them.

A computation uses one thread, unless ``OMP_NUM_THREADS`` is set. The service runs several
computations at a time (``HELIOTWIN_PARALLEL_COMPUTATIONS``). Each has many small steps: a matrix
with hundreds of rows, or the transform of an image of 64 x 64 pixels. A library's threads would
share such a step and spin until the last of them is done. If another process occupies a core, that
last thread returns a time slice later, and every step waits for it. `benchmarks.busy` measures this
effect. Only a refinement fits two halves of its images in parallel (`model.refinement`). These
share no step.
"""

import ctypes
import fcntl
import os
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

# Read once, on import, by OpenBLAS (numpy, SciPy), OpenMP (PyTorch), MKL and OpenCV.
_VARIABLES = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "OPENCV_FOR_THREADS_NUM",
)


def limit_threads() -> None:
    """Set the number of threads of numerical libraries before their import. Child processes inherit
    it.

    Environment variables are used because importing the libraries takes seconds, which most
    commands avoid.
    """
    count = os.environ.get("OMP_NUM_THREADS", "1")
    for name in _VARIABLES:
        os.environ.setdefault(name, count)


# From glibc's `malloc.h`: the number of arenas that threads share.
_M_ARENA_MAX = -8

_ARENAS = 2

_RETURN_EVERY_S = 20.0

_libc = ctypes.CDLL(None) if sys.platform.startswith("linux") else None


def limit_memory() -> bool:
    """Limit glibc to a few arenas; False without glibc, or if ``MALLOC_ARENA_MAX`` is set.

    Otherwise each thread gets an arena, up to eight per core, which keeps freed memory. The forty
    threads of the routes would each keep the memory of images and their spectra.
    """
    if "MALLOC_ARENA_MAX" in os.environ:
        return False
    mallopt = getattr(_libc, "mallopt", None)  # musl has no such function.
    return mallopt is not None and mallopt(_M_ARENA_MAX, _ARENAS) == 1


def return_memory() -> None:
    """Return freed memory to the system, as far as glibc still holds it.

    Blocks that are used lie between freed ones after large computations, and glibc keeps those.
    """
    trim = getattr(_libc, "malloc_trim", None)
    if trim is not None:
        trim(0)


def returning_memory() -> AbstractContextManager[None]:
    """Call `return_memory` from time to time while the block runs."""

    def work(ended: threading.Event) -> None:
        while not ended.wait(_RETURN_EVERY_S):
            return_memory()

    return in_background(work, "return-memory")


@contextmanager
def in_background(work: Callable[[threading.Event], None], name: str) -> Iterator[None]:
    """Run ``work`` in a thread of this ``name``, and set its event at the end of the block."""
    ended = threading.Event()
    thread = threading.Thread(target=work, args=(ended,), name=name, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


@contextmanager
def file_lock(path: Path, *, shared: bool = False, wait: bool = True) -> Iterator[bool]:
    """Hold a lock file until the block or the process ends, even if it is killed.

    Yields False, without the lock, if another process or thread holds it and ``wait`` is False.
    The folder of ``path`` must exist.
    """
    descriptor = os.open(path, os.O_CREAT | os.O_RDWR, 0o644)
    try:
        kind = fcntl.LOCK_SH if shared else fcntl.LOCK_EX
        try:
            fcntl.flock(descriptor, kind if wait else kind | fcntl.LOCK_NB)
        except BlockingIOError:
            yield False
        else:
            yield True
    finally:
        os.close(descriptor)
