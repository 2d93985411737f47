"""Limited memory use of processes with many threads."""

import ctypes
import os
import sys

# From glibc's `malloc.h`: the number of arenas that threads share.
_M_ARENA_MAX = -8

_ARENAS = 2


def limit_memory() -> bool:
    """Limit glibc to a few arenas; False without glibc, or if ``MALLOC_ARENA_MAX`` is set.

    Otherwise each thread gets an arena, up to eight per core, which keeps freed memory. The forty
    threads of the routes would each keep the memory of images and their spectra.
    """
    if not sys.platform.startswith("linux") or "MALLOC_ARENA_MAX" in os.environ:
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)  # musl has no such function.
    return mallopt is not None and mallopt(_M_ARENA_MAX, _ARENAS) == 1
