"""One thread for each computation, in every library that would start its own."""

import json
import os
import subprocess
import sys

import pytest

POOLS = """
import json
import service
import cv2, numpy, scipy.linalg, torch, threadpoolctl
pools = [pool["num_threads"] for pool in threadpoolctl.threadpool_info()]
print(json.dumps({"pools": pools, "torch": torch.get_num_threads(), "cv2": cv2.getNumThreads()}))
"""


def pools(**environment: str) -> dict[str, object]:
    """Threads that a process which loads the service takes in each library."""
    kept = {
        name: value
        for name, value in os.environ.items()
        if not name.endswith(("_NUM_THREADS", "_THREADS_NUM"))
    }
    done = subprocess.run(
        [sys.executable, "-c", POOLS],
        env=kept | environment,
        capture_output=True,
        text=True,
        check=True,
    )
    return json.loads(done.stdout)


@pytest.mark.full
def test_each_library_takes_one_thread_unless_it_is_told_otherwise():
    found = pools()
    assert set(found["pools"]) == {1}
    assert (found["torch"], found["cv2"]) == (1, 1)
    found = pools(OMP_NUM_THREADS="2")
    assert set(found["pools"]) == {2}
    assert (found["torch"], found["cv2"]) == (2, 2)
