"""The service or a worker on a stand-in for the model: ``python -m tests.faults.process
serve|worker``.

The faults are real, the model is not. It answers at once, and predictions take a configured time.
The clock is the machine's, shifted by the number of seconds in the file
``HELIOTWIN_FAULTS_CLOCK``.
"""

import os
import sys
import threading
import time
from datetime import datetime, timedelta, tzinfo
from pathlib import Path
from typing import Any

from service.base.settings import Settings
from service.jobs.kinds import KINDS
from service.jobs.worker import work
from service.store import columns
from service.twin import runtime
from service.web import app
from tests.service.conftest import FakeOperations


class SlowOperations(FakeOperations):
    """Takes its time for a prediction, and for one more than ``HELIOTWIN_FAULTS_MOST_PREDICTIONS``
    all there is.
    """

    def predict(self, *arguments: Any, **options: Any) -> Any:
        time.sleep(float(os.environ.get("HELIOTWIN_FAULTS_PAUSE_S", "0")))
        if len(self.predictions) >= float(
            os.environ.get("HELIOTWIN_FAULTS_MOST_PREDICTIONS", "inf")
        ):
            threading.Event().wait()
        return super().predict(*arguments, **options)


class ShiftedClock(datetime):
    """What `service.store.columns.now`, from which all of the service has the time, asks."""

    @classmethod
    def now(cls, tz: tzinfo | None = None) -> datetime:  # type: ignore[override]
        file = os.environ.get("HELIOTWIN_FAULTS_CLOCK")
        offset_s = float(Path(file).read_text() or 0) if file and Path(file).is_file() else 0.0
        return datetime.now(tz) + timedelta(seconds=offset_s)


def run(what: str) -> None:
    """Serve, or work as a worker, until a signal ends it."""
    columns.datetime = ShiftedClock  # type: ignore[misc]
    runtime.load_operations = lambda *_: SlowOperations()  # type: ignore[assignment]
    if what == "worker":
        work(Settings(), KINDS)
    else:
        app.serve(Settings())


if __name__ == "__main__":
    run(sys.argv[1])
