"""The harness ends what it started, and a test that waits for what never comes ends too."""

import sys

import pytest

from tests.faults.harness import Process, Store
from tests.waiting import child_process, until


def test_what_never_comes_ends_the_test():
    with pytest.raises(AssertionError, match="rain: it does not happen"):
        until(lambda: False, "rain", 0.0)
    assert until(lambda: "sun", "sun", 0.0) == "sun"


def test_a_child_process_is_reaped_although_the_test_fails():
    with (
        pytest.raises(ZeroDivisionError),
        child_process([sys.executable, "-c", "input()"], stdin=-1, stderr=-1) as child,
    ):
        raise ZeroDivisionError
    assert child.returncode == -9
    assert child.stdin is not None
    assert child.stdin.closed


def test_a_service_that_does_not_start_in_time_leaves_no_process(tmp_path):
    """Its `ResourceWarning` failed whichever test ran when it was collected."""
    service = Process(Store(tmp_path, None), start_limit_s=0.0)
    with pytest.raises(AssertionError, match="the service answers: it does not happen"), service:
        pass
    assert service.has_ended
