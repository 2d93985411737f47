"""The tables of work and of who asks for it: jobs and their steps, keys, acknowledgements, the audit trail."""

from datetime import datetime
from typing import Any, get_args

from sqlalchemy import ForeignKey, Index, LargeBinary, String, UniqueConstraint
from sqlalchemy.orm import Mapped, mapped_column

from service.base.choices import RoleName
from service.store.columns import Base, now, one_of

STATES = ("queued", "running", "done", "failed", "cancelled")
ROLES: tuple[str, ...] = get_args(RoleName)


class JobRow(Base):
    """A piece of work that outlives the request that asked for it; `service.store.queue` says how it changes.

    ``lease_token`` names the one worker that may write to it until ``lease_until``; ``revision`` counts what a watcher
    may see of it; npz ``arrays`` is the part of the result that is no JSON.
    """

    __tablename__ = "jobs"
    __table_args__ = (
        UniqueConstraint("created_by", "idempotency_key"),
        Index(None, "state", "not_before"),
        one_of("state", STATES),
    )

    id: Mapped[int] = mapped_column(primary_key=True)
    kind: Mapped[str] = mapped_column(String(32))
    payload: Mapped[dict[str, Any]]
    state: Mapped[str] = mapped_column(String(16), default="queued")
    created_by: Mapped[str] = mapped_column(String(64))
    idempotency_key: Mapped[str | None] = mapped_column(String(128))
    created_at: Mapped[datetime] = mapped_column(default=now)
    not_before: Mapped[datetime] = mapped_column(default=now)
    started_at: Mapped[datetime | None]
    finished_at: Mapped[datetime | None]
    attempts: Mapped[int] = mapped_column(default=0)
    cancel_requested: Mapped[bool] = mapped_column(default=False)
    progress: Mapped[float] = mapped_column(default=0.0)
    message: Mapped[str] = mapped_column(String(200), default="")
    revision: Mapped[int] = mapped_column(default=1)
    worker: Mapped[str | None] = mapped_column(String(96))
    lease_token: Mapped[str | None] = mapped_column(String(32))
    lease_until: Mapped[datetime | None]
    reason: Mapped[str | None] = mapped_column(String(1000))
    result: Mapped[dict[str, Any] | None]
    arrays: Mapped[bytes | None] = mapped_column(LargeBinary, deferred=True)


class JobStepRow(Base):
    """A part of a job that is done for good: stored in one transaction with what it did, never done again."""

    __tablename__ = "job_steps"

    job_id: Mapped[int] = mapped_column(ForeignKey("jobs.id"), primary_key=True)
    name: Mapped[str] = mapped_column(String(96), primary_key=True)
    result: Mapped[dict[str, Any]]


class KeyRow(Base):
    """An API key by its hash; a withdrawn one stays, so that its name keeps its meaning in the audit trail."""

    __tablename__ = "api_keys"
    __table_args__ = (one_of("role", ROLES),)

    id: Mapped[int] = mapped_column(primary_key=True)
    name: Mapped[str] = mapped_column(String(64), unique=True)
    prefix: Mapped[str] = mapped_column(String(16), unique=True)
    sha256: Mapped[str] = mapped_column(String(64))
    role: Mapped[str] = mapped_column(String(16))
    created_at: Mapped[datetime] = mapped_column(default=now)
    withdrawn_at: Mapped[datetime | None]


class AcknowledgementRow(Base):
    """That somebody has seen what needed attention, of a heliostat or of the plant (`service.twin.attention`).

    It holds while the same thing, by its ``mark``, is the reason.
    """

    __tablename__ = "acknowledgements"

    id: Mapped[int] = mapped_column(primary_key=True)
    heliostat_id: Mapped[int | None] = mapped_column(ForeignKey("heliostats.id"), index=True)
    reason: Mapped[str] = mapped_column(String(32))
    mark: Mapped[str] = mapped_column(String(96))
    made_at: Mapped[datetime] = mapped_column(default=now)
    made_by: Mapped[str] = mapped_column(String(64))


class AuditRow(Base):
    """Who did what when; rows are only ever added, and go when they are old (`service.store.retention`)."""

    __tablename__ = "audit"

    id: Mapped[int] = mapped_column(primary_key=True)
    at: Mapped[datetime] = mapped_column(default=now)
    actor: Mapped[str] = mapped_column(String(64))
    action: Mapped[str] = mapped_column(String(64))
    subject: Mapped[str] = mapped_column(String(128))
    detail: Mapped[dict[str, Any]]
