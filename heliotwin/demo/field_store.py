"""Fill the store of the demonstration's field by import, jobs and received photographs."""

import shutil
import threading
import time
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from heliotwin.demo.field import (
    ARCHIVED_DAYS,
    FAULTS,
    ROWS,
    faulty_heliostats,
    plan_photographs,
    write_layout,
    write_measured_surfaces,
    write_photographs,
)
from service.base.progress import Progress, no_progress
from service.base.settings import Settings
from service.jobs.enqueuing import enqueue
from service.jobs.kinds import KINDS
from service.jobs.worker import Worker
from service.sources.folder import MeasurementFolder, read_folder
from service.store import queue
from service.store.job_tables import JobRow
from service.twin.importing import import_folder
from service.twin.photographs.repeats import receive
from service.twin.runtime import Runtime

ACTOR = "demo"
"""Who the store says made its jobs and sent its photographs."""

_THREADS = 2
_POLL_S = 0.1
_EVERY = 4  # of the heliostats without an alarm, every fourth has a predicted surface
_LIMIT_W_M2 = 4e5  # of the receiver


def seed_field(
    root: Path,
    store: Path,
    counting: Callable[[int], Progress] = lambda total: no_progress,
    *,
    rows: int = ROWS,
) -> None:
    """Write the field's folder ``root`` and fill the ``store``.

    Older photographs are imported, and give surfaces and mounts. Newer ones are received one by
    one, as by the service, so each is compared with its forecast. A store that exists is left as it
    is. ``counting`` takes the number of steps, and returns what each of them is reported to.
    """
    if store.exists():
        return
    begun = store.with_name(f"{store.name}-unfinished")
    for old in (root, begun):
        shutil.rmtree(old, ignore_errors=True)
    now = datetime.now(UTC)
    begin = now - timedelta(days=ARCHIVED_DAYS)
    plant = write_layout(root, rows)
    photographs = plan_photographs(plant, now)
    older = [one for one in photographs if one.taken_at < begin]
    newer = [one for one in photographs if one.taken_at >= begin]
    names = sorted({one.mirror.name for one in older})
    # Each photograph is written, then imported or received.
    progress = counting(2 * len(photographs) + len(names))
    runtime = Runtime.from_settings(Settings(data_dir=begun, database_url=None, host="127.0.0.1"))
    try:
        runtime.database.upgrade()
        import_folder(runtime, read_folder(root, [], whole_field=True), actor=ACTOR)
        write_measured_surfaces(root, older)
        write_photographs(root, plant, older, progress)
        _in_threads(
            lambda part: import_folder(runtime, read_folder(root, part), progress, ACTOR), names
        )
        others = sorted(set(names) - faulty_heliostats())
        chosen = sorted(faulty_heliostats() | set(others[::_EVERY]))
        _in_threads(lambda part: run_job(runtime, "predictions", heliostats=part, images=8), chosen)
        run_job(runtime, "calibrations")
        write_photographs(root, plant, newer, progress)
        folder = read_folder(root, sorted({one.mirror.name for one in newer}))
        sent = {str(one.number) for one in newer}
        _in_threads(
            lambda part: _receive(runtime, folder, part, sent, progress),
            list(folder.plant.heliostats),
        )
        _do_work(runtime, now)
    finally:
        runtime.close()
    begun.rename(store)


def _do_work(runtime: Runtime, now: datetime) -> None:
    """Predict some surfaces again, study the hazy days, and plan the day."""
    midnight = now.replace(hour=0, minute=0, second=0, microsecond=0)
    names = sorted(faulty_heliostats())
    run_job(runtime, "predictions", heliostats=names[:4])
    first, last = next(fault.days for fault in FAULTS if fault.kind == "hazy")
    days = {"since": midnight - timedelta(days=first), "until": midnight - timedelta(days=last)}
    candidates = ["sun_shape", "slope_error", "camera_blur"]
    run_job(runtime, "studies", heliostats=names, images=8, candidates=candidates, **days)
    noon = midnight + timedelta(hours=12)
    receiver = {"target": "main", "dni_w_m2": "clear_sky"}
    run_job(runtime, "forecasts", sun={"at": noon}, resolution=(64, 64), **receiver)
    hours = {"first_at": noon - timedelta(hours=2), "last_at": noon + timedelta(hours=2)}
    plan = {"name": "all to the middle", "step_minutes": 120, "allowed_w_m2": _LIMIT_W_M2}
    run_job(runtime, "plans", resolution=(32, 32), **hours, **plan, **receiver)
    run_job(runtime, "aim-plans", sun={"at": noon}, limit_w_m2=_LIMIT_W_M2, **receiver)


def _in_threads(work: Callable[[list[str]], object], names: Sequence[str]) -> None:
    """Work on parts of the names in threads, and raise what one of them raised."""
    parts = [list(names[start::_THREADS]) for start in range(_THREADS)]
    with ThreadPoolExecutor(_THREADS) as pool:
        list(pool.map(work, filter(None, parts)))


def run_job(runtime: Runtime, job: str, **payload: Any) -> JobRow:
    """Queue a job, and work until it is done, also if an attempt fails and another one follows."""
    kind = KINDS[job]
    number = enqueue(runtime, kind, kind.payload.model_validate(payload), ACTOR).row.id
    worker = Worker(runtime, KINDS, ACTOR, threading.Event())
    while (row := _read_job(runtime, number)).state not in queue.ENDED:
        if not worker.work():
            time.sleep(_POLL_S)
    if row.state != "done":
        raise RuntimeError(f"job {number} ({job}) {row.state}: {row.reason}")
    return row


def _read_job(runtime: Runtime, number: int) -> JobRow:
    with runtime.database.reading() as session:
        return queue.get_job(session, number)


def _receive(
    runtime: Runtime,
    folder: MeasurementFolder,
    names: Sequence[str],
    sent: Collection[str],
    progress: Progress,
) -> None:
    """Receive the ``sent`` photographs of heliostats, in the order of their numbers."""
    for name in names:
        for one in folder.measurements(name):
            if one.external_id in sent:
                progress(one.key)
                (image,) = one.images.items()
                receive(runtime, name, one.photograph(image[0]), image[1].read_bytes(), actor=ACTOR)
