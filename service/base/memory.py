"""Memory that a process of many threads gives back."""

import ctypes
import os
import sys

# `malloc.h` of glibc: how many heaps threads share.
_M_ARENA_MAX = -8

_ARENAS = 2


def limit() -> bool:
    """Let all threads share a few heaps of glibc's; False where there is none, or ``MALLOC_ARENA_MAX`` is set.

    Each thread otherwise gets a heap of its own, up to eight for each core, and keeps there what it has freed: images
    and their spectra in each of the forty threads that routes run in.
    """
    if not sys.platform.startswith("linux") or "MALLOC_ARENA_MAX" in os.environ:
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)  # musl has none
    return mallopt is not None and mallopt(_M_ARENA_MAX, _ARENAS) == 1
