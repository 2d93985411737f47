"""Limited memory use of processes with many threads."""

import ctypes
import os
import sys
import threading
from contextlib import AbstractContextManager

from service.base.background import in_background

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
