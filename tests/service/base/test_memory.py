"""Threads of the service share a few heaps."""

import os
import platform
import subprocess
import sys
import xml.etree.ElementTree as ElementTree

import pytest

HEAPS = """
import ctypes, sys, threading
from service.base import processes
libc = ctypes.CDLL(None)
limited = processes.limit_memory() if "limit" in sys.argv else None
libc.malloc.restype = ctypes.c_void_p
ready = threading.Barrier(13)
def take():
    libc.malloc(ctypes.c_size_t(1000))
    ready.wait()
    ready.wait()
threads = [threading.Thread(target=take) for _ in range(12)]
for thread in threads:
    thread.start()
ready.wait()
libc.fdopen.restype = ctypes.c_void_p
out = ctypes.c_void_p(libc.fdopen(1, b"w"))
libc.malloc_info(0, out)
libc.fflush(out)
ready.wait()
print(limited, file=sys.stderr)
"""


def heaps(*arguments: str, **more: str) -> tuple[int, str]:
    kept = {name: value for name, value in os.environ.items() if name != "MALLOC_ARENA_MAX"}
    done = subprocess.run(
        [sys.executable, "-c", HEAPS, *arguments],
        env=kept | more,
        capture_output=True,
        text=True,
        check=True,
    )
    return len(ElementTree.fromstring(done.stdout).findall("heap")), done.stderr.strip()


RETURNED = """
import os, time
from pathlib import Path
from service.base import processes
def resident():
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
processes.limit_memory()
blocks = [b"1" * 60_000 for _ in range(2_000)]  # zeros may take no memory
highest = resident()
del blocks[:-1]  # the last one keeps the heap as large as it is
print(highest - resident())
processes._RETURN_EVERY_S = 0.01
with processes.returning_memory():
    while highest - resident() < 100e6:
        time.sleep(0.01)
print(highest - resident())
"""

only_glibc = pytest.mark.skipif(
    "glibc" not in platform.libc_ver(), reason="only glibc has these heaps"
)


@only_glibc
def test_freed_memory_is_returned():
    """Most of 120 MB, which glibc keeps without that."""
    done = subprocess.run(
        [sys.executable, "-c", RETURNED], capture_output=True, text=True, check=True, timeout=300
    )
    kept, returned = map(int, done.stdout.split())
    assert kept < 20e6 < 100e6 <= returned


@only_glibc
def test_threads_share_two_heaps_unless_the_environment_says_otherwise():
    assert heaps()[0] > 2
    assert heaps("limit") == (2, "True")
    assert heaps("limit", MALLOC_ARENA_MAX="4")[1] == "False"
