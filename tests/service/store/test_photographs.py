"""Images are deleted by age and by quota, but never those of active surfaces.

A file is deleted after its row, never while a row refers to it.
"""

import threading
from concurrent.futures import ThreadPoolExecutor
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import select, update

from service import store
from service.base.errors import StoreFullError
from service.base.fields import Sun
from service.base.settings import Settings
from service.jobs.enqueuing import enqueue_due
from service.jobs.kind import Context
from service.jobs.kinds import KINDS
from service.jobs.kinds.prunings import PruningsIn, prune
from service.jobs.worker import Worker
from service.sources.photograph import IncomingPhotograph
from service.store import audit, image_files, queue, sizes
from service.store.backup import back_up, restore
from service.store.check import inspect_store
from service.store.columns import now
from service.store.database import Database
from service.store.image_files import ImageStore, digest
from service.store.job_tables import JobRow
from service.store.keys import RESERVED
from service.store.tables import ImageRow, MeasurementRow
from service.twin import plant_setup
from service.twin.photographs.ingest import ingest
from service.twin.runtime import Runtime
from service.twin.surfaces.prediction import predict_surface
from tests.service.conftest import png, properties_document, sun_at
from tests.service.store.stores import PHOTOGRAPH

# `runtime` has the photographs 0 to 3, a surface made from them, and 9, which came after it.
TODAYS = {1, 2, 3}


def with_(runtime: Runtime, **changes: Any) -> Runtime:
    """The same store under other settings."""
    quiet = {"refused_image_retention_days": 0, "image_retention_days": 0, "image_quota_gb": 0}
    return Runtime(
        runtime.settings.model_copy(update={**quiet, **changes}),
        runtime.database,
        runtime.images,
        runtime.operations,
    )


def age(runtime: Runtime, days: float, *seeds: int) -> None:
    with runtime.database.writing() as session:
        chosen = update(ImageRow).where(
            ImageRow.sha256.in_([digest(picture(seed)) for seed in seeds])
        )
        session.execute(chosen.values(created_at=now() - timedelta(days=days)))


def picture(seed: int) -> bytes:
    return png(seed, refused=seed >= 50)


def give(runtime: Runtime, *seeds: int) -> None:
    for seed in seeds:
        ingest(runtime, "AA39", PHOTOGRAPH, picture(seed))


def give_to_another(runtime: Runtime, heliostat: str, data: bytes) -> tuple[MeasurementRow, bool]:
    """The same image, which this heliostat has, too."""
    with runtime.database.writing() as session:
        plant_setup.set_heliostat(
            session, plant_setup.Authorship("tester"), heliostat, properties_document()
        )
    return ingest(
        runtime,
        heliostat,
        IncomingPhotograph("lower", "flux", Sun(**sun_at()), forced="both have it"),
        data,
    )


def do(runtime: Runtime) -> dict[str, Any]:
    """A pruning, as a worker does it."""
    with runtime.database.writing() as session:
        queue.add_job(session, "prunings", {}, "tester")
        job = queue.claim(session, ["prunings"], "tester", 60.0, 3)
        assert job is not None
        lease = queue.lease_of(job)
    result = prune(Context(runtime, lease, "tester", threading.Event()), PruningsIn())
    with runtime.database.writing() as session:
        queue.finish(session, lease, result.figures)
    return result.figures


def kept(runtime: Runtime, *seeds: int) -> set[int]:
    """Those of these images whose files are there; the rows say the same."""
    found = {seed for seed in seeds if runtime.images.path(digest(picture(seed))).is_file()}
    with runtime.database.reading() as session:
        rows = {seed: session.get_one(ImageRow, digest(picture(seed))) for seed in seeds}
    assert found == {seed for seed, row in rows.items() if row.pruned_at is None}
    assert found == {seed for seed, row in rows.items() if row.removed_at is None}
    return found


def totals_hold(database: Database) -> None:
    """The totals are what the rows add up to."""
    with database.reading() as session:
        held = sizes.sizes(session)
        for accepted, found in ((True, held.accepted), (False, held.refused)):
            rows = session.scalars(
                select(ImageRow).where(ImageRow.pruned_at.is_(None), ImageRow.accepted == accepted)
            )
            listed = rows.all()
            assert (found.images, found.size_bytes) == (
                len(listed),
                sum(row.size_bytes for row in listed),
            )
            assert found.oldest == min((row.created_at for row in listed), default=None)
        assert held.database_bytes > 10_000


def actions(runtime: Runtime) -> list[Any]:
    with runtime.database.reading() as session:
        return [entry for entry in audit.entries(session, 20) if entry.action == "images.pruned"]


def test_old_images_go_and_rows_stay(runtime: Runtime):
    give(runtime, 50, 51)
    age(runtime, 100, 50, 1, 9)
    done = do(with_(runtime, refused_image_retention_days=90, image_retention_days=90))
    assert kept(runtime, 1, 2, 3, 9, 50, 51) == {*TODAYS, 51}
    assert (done["images"], done["files_removed"]) == (2, 2)
    assert done["bytes"] == len(picture(9)) + len(picture(50))
    totals_hold(runtime.database)
    with runtime.database.reading() as session:
        heliostat = store.get_heliostat(session, "AA39")
        assert len(store.list_measurements(session, heliostat, 50)) == 7
        row = store.get_measurement(session, heliostat, digest(picture(9))[:16], arrays=True)
        assert row.arrays is not None
        assert (row.image.pruned_for, row.accepted) == ("age", True)
    noted = [
        (entry.actor, entry.subject, entry.detail["which"], entry.detail["size_bytes"])
        for entry in actions(runtime)
    ]
    assert noted == [
        ("tester", "1 images", "accepted", len(picture(9))),
        ("tester", "1 images", "refused", len(picture(50))),
    ]
    assert (
        actions(runtime)[0].detail["oldest"].startswith(f"{now() - timedelta(days=100):%Y-%m-%d}")
    )
    report = inspect_store(runtime.database, runtime.images, lambda _: None)
    assert report.is_sound
    assert (report.pruned, report.unused) == (2, 0)


def test_quota_takes_refused_ones_then_unused_ones_then_those_of_former_surfaces(runtime: Runtime):
    give(runtime, 50)
    predict_surface(
        runtime, "AA39", measurements=[digest(picture(9))[:16]]
    )  # the active surface is made from 9 alone
    give(runtime, 10)
    age(runtime, 30, 1, 2, 3, 9)
    seeds = (1, 2, 3, 9, 10, 50)
    with runtime.database.reading() as session:
        rest = sizes.image_bytes(session)
    for expected in ({1, 2, 3, 9, 10}, {1, 2, 3, 9}):
        rest -= len(picture(50 if 10 in expected else 10))
        do(with_(runtime, image_quota_gb=rest / 1e9))
        assert kept(runtime, *seeds) == expected
        totals_hold(runtime.database)
    do(with_(runtime, image_quota_gb=1e-9))
    assert kept(runtime, *seeds) == {9}
    totals_hold(runtime.database)
    assert {entry.detail["which"] for entry in actions(runtime)} == {
        "refused",
        "unused",
        "of former surfaces",
    }


def test_post_beyond_the_quota_is_kept_as_long_as_something_can_go(runtime: Runtime):
    tight = with_(runtime, image_quota_gb=1e-9)
    give(tight, 60)
    do(tight)
    assert kept(runtime, *TODAYS, 9, 60) == TODAYS
    with pytest.raises(StoreFullError, match="HELIOTWIN_IMAGE_QUOTA_GB"):
        give(tight, 61)
    assert not runtime.images.path(digest(picture(61))).exists()
    give(tight, 1, 9)  # known ones are answered all the same
    assert kept(runtime, 1, 9) == {1}


def test_pruned_photograph_posted_again_stays_away_unless_it_says_something_new(runtime: Runtime):
    age(runtime, 100, 9)
    settings = {"image_retention_days": 90.0}
    do(with_(runtime, **settings))
    assert not ingest(runtime, "AA39", PHOTOGRAPH, picture(9))[1]
    assert kept(runtime, 9) == set()
    row, is_new = give_to_another(runtime, "AB38", picture(9))
    assert is_new
    assert row.image.pruned_at is None
    assert kept(runtime, 9) == {9}
    do(with_(runtime, **settings))  # it came today
    assert kept(runtime, 9) == {9}
    totals_hold(runtime.database)


def test_file_that_is_removed_while_it_is_posted_is_written_again(
    runtime: Runtime, monkeypatch: pytest.MonkeyPatch
):
    """The sender found the file whole, a pruning took it, then the sender's row is written."""
    age(runtime, 100, 9)
    aged, found = with_(runtime, image_retention_days=90.0), ImageStore.put

    def put_then_prune(images: ImageStore, data: bytes) -> str:
        monkeypatch.setattr(ImageStore, "put", found)
        sha256 = found(images, data)
        assert do(aged)["files_removed"] == 1
        return sha256

    monkeypatch.setattr(ImageStore, "put", put_then_prune)
    assert give_to_another(runtime, "AB38", picture(9))[1]
    assert kept(runtime, 9) == {9}
    assert inspect_store(runtime.database, runtime.images, lambda _: None).is_sound


@pytest.mark.full
def test_post_and_pruning_at_once_leave_no_row_without_its_file(runtime: Runtime):
    aged, stop = with_(runtime, image_retention_days=90.0), threading.Event()

    def keep_pruning() -> None:
        while not stop.is_set():
            with runtime.database.writing() as session:
                session.execute(update(ImageRow).values(created_at=now() - timedelta(days=100)))
            do(aged)

    with ThreadPoolExecutor(1) as pool:
        pruning = pool.submit(keep_pruning)
        for heliostat in ("AB01", "AB02", "AB03"):
            for seed in range(100, 110):
                give_to_another(runtime, heliostat, png(seed))
        stop.set()
        pruning.result()
    report = inspect_store(runtime.database, runtime.images, lambda _: None)
    assert (report.bad, report.unused) == ({}, 0)
    totals_hold(runtime.database)


def test_files_wait_for_a_back_up(
    runtime: Runtime, elsewhere: Settings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """The snapshot names an image that is marked for deletion before it is copied."""
    age(runtime, 100, 9)
    aged, results = with_(runtime, image_retention_days=90.0), []

    def step(name: str) -> None:
        if name != "database" and not results:
            results.append(do(aged))

    manifest = back_up(runtime.settings, tmp_path / "one", step)
    assert (manifest.images, manifest.damaged) == (5, [])
    assert (results[0]["images"], results[0]["files_removed"]) == (1, 0)
    assert "back-up" in results[0]["note"]
    report = inspect_store(runtime.database, runtime.images, lambda _: None)
    assert (report.bad, report.unused) == ({}, 0)
    assert do(aged)["files_removed"] == 1
    assert kept(runtime, 9) == set()
    assert back_up(runtime.settings, tmp_path / "two").images == 4
    restore(elsewhere, tmp_path / "two")
    database = Database(elsewhere.database)
    images = ImageStore(elsewhere.data_dir / "images")
    assert inspect_store(database, images, lambda _: None).is_sound
    totals_hold(database)
    database.close()


def test_check_does_not_call_lost_what_was_given_up_meanwhile(runtime: Runtime):
    age(runtime, 100, 9)
    done: list[Any] = []

    def step(_: str) -> None:
        if not done:
            done.append(do(with_(runtime, image_retention_days=90.0)))

    assert inspect_store(runtime.database, runtime.images, step).is_sound
    assert done[0]["files_removed"] == 1


def test_workers_begin_a_pruning_when_it_is_due_and_once(runtime: Runtime):
    def jobs() -> list[str]:
        with runtime.database.reading() as session:
            rows = session.scalars(
                select(JobRow).where(JobRow.kind == "prunings").order_by(JobRow.id)
            )
            return [row.idempotency_key or "" for row in rows]

    aged = with_(runtime, image_retention_days=90.0)
    enqueue_due(aged, KINDS)
    assert jobs() == []
    with runtime.database.writing() as session:  # somebody else's key of the same text is no matter
        queue.add_job(session, "forecasts", {}, RESERVED, f"prunings-{now():%Y-%m-%d}")
    age(runtime, 100, 9)
    for _ in range(2):
        Worker(aged, KINDS, "one", threading.Event())._purge()
    assert jobs() == [f"prunings-{now():%Y-%m-%d}"]
    Worker(with_(runtime, image_quota_gb=1e-9), KINDS, "two", threading.Event())._purge()
    assert [len(key) for key in jobs()] == [
        len("prunings-2026-11-22"),
        len("prunings-2026-11-22T13"),
    ]
    while Worker(aged, {"prunings": KINDS["prunings"]}, "three", threading.Event()).work():
        pass
    assert kept(runtime, *TODAYS, 9) == TODAYS


def test_image_of_two_photographs_is_accepted_where_one_is(runtime: Runtime):
    give(runtime, 50)
    totals_hold(runtime.database)
    with runtime.database.writing() as session:
        row = session.scalars(
            select(MeasurementRow).where(MeasurementRow.image_sha256 == digest(picture(50)))
        ).one()
        plant_setup.set_heliostat(
            session, plant_setup.Authorship("tester"), "AB38", properties_document()
        )
        heliostat, target = store.get_heliostat(session, "AB38"), store.get_target(session, "lower")
        image = session.get_one(ImageRow, row.image_sha256)
        again = MeasurementRow(
            kind="flux",
            forced="both have it",
            target_id=target.id,
            sun_azimuth_deg=1.0,
            sun_elevation_deg=2.0,
            accepted=True,
            quality={},
        )
        store.add_measurement(session, heliostat, image, again)
    totals_hold(runtime.database)
    with runtime.database.reading() as session:
        assert session.get_one(ImageRow, digest(picture(50))).accepted


def test_nothing_is_given_up_where_the_settings_keep_all(runtime: Runtime):
    age(runtime, 30_000, 1, 2, 3, 9)
    forever = with_(runtime)
    with runtime.database.reading() as session:
        assert image_files.retention_rules(session, forever.settings) == []
    assert do(forever)["images"] == 0
