"""Jobs, forecasts and audit entries are kept as long as the settings say, and no number is given
twice.
"""

import threading
from datetime import timedelta

import pytest
from sqlalchemy import select, update

from service.base.settings import Settings
from service.jobs.worker import Worker
from service.store import audit, deletion, queue
from service.store.columns import now
from service.store.database import Database
from service.store.job_tables import AuditRow, JobRow
from service.store.tables import ForecastRow
from service.twin.runtime import Runtime
from tests.service.conftest import FakeOperations
from tests.service.store.rows import fill

_RETENTIONS = ("job_retention_days", "forecast_retention_days", "audit_retention_days")


def age(database: Database, *keep: int) -> None:
    """Make all forecasts and entries two thousand days old, but for forecasts of these ids."""
    with database.writing() as session:
        old = now() - timedelta(days=2000)
        session.execute(
            update(ForecastRow).where(ForecastRow.id.not_in(keep)).values(created_at=old)
        )
        session.execute(update(AuditRow).values(created_at=old))


def numbers(database: Database) -> list[int]:
    with database.reading() as session:
        return list(session.scalars(select(ForecastRow.id).order_by(ForecastRow.id)))


def test_old_forecasts_go_a_few_at_a_time_and_the_newest_stays(database: Database):
    fill(database, 6)
    ids = numbers(database)
    age(database, ids[1])
    year = timedelta(days=365)
    for most, expected in ((1, 1), (500, 3), (500, 0)):
        with database.writing() as session:
            assert deletion.prune_forecasts(session, year, most) == expected
    assert numbers(database) == [ids[1], ids[5]]


def test_old_jobs_go_and_that_is_noted(database: Database):
    with database.writing() as session:
        for number in range(4):
            queue.add_job(session, "squares", {"value": number}, "tester")
        session.execute(
            update(JobRow).values(state="done", finished_at=now() - timedelta(days=2000))
        )
    for expected in (2, 1, 0):  # the newest stays, so that no number is given twice
        with database.writing() as session:
            assert deletion.prune_jobs(session, timedelta(days=90), most=2) == expected
    with database.reading() as session:
        noted = [
            (entry.action, entry.subject, entry.detail) for entry in audit.entries(session, 10)
        ]
    older = {"older_than_days": 90.0}
    assert noted == [("jobs.pruned", "1 jobs", older), ("jobs.pruned", "2 jobs", older)]


def test_old_entries_go_and_that_is_noted(database: Database):
    with database.writing() as session:
        for number in range(4):
            audit.record(session, "tester", "plant.set", f"plant {number}")
    age(database)
    with database.writing() as session:
        assert deletion.prune_audit(session, timedelta(days=365)) == 3
    with database.reading() as session:
        assert [entry.action for entry in audit.entries(session, 10)] == [
            "audit.pruned",
            "plant.set",
        ]


@pytest.mark.parametrize("days", [365.0, 0.0])
def test_worker_deletes_what_the_settings_say(settings: Settings, days: float):
    changed = settings.model_copy(update=dict.fromkeys(_RETENTIONS, days))
    runtime = Runtime.from_settings(changed, FakeOperations())
    try:
        runtime.database.upgrade()
        fill(runtime.database, 3)
        age(runtime.database)
        with runtime.database.writing() as session:
            old = now() - timedelta(days=days + 100)
            session.add_all(
                JobRow(kind="k", payload={}, created_by="a", state="done", finished_at=old)
                for _ in "ab"
            )
        worker = Worker(runtime, {}, "tester", threading.Event())
        for _ in range(3):
            worker._purge()
        assert len(numbers(runtime.database)) == (1 if days else 3)
        with runtime.database.reading() as session:
            noted = {
                entry.subject
                for entry in audit.entries(session, 10)
                if entry.action.endswith(".pruned")
            }
        assert noted == ({"1 jobs", "2 forecasts"} if days else set())
    finally:
        runtime.close()
