"""Tables of jobs, their steps, API keys, sessions, acknowledgements and the audit trail."""

from datetime import datetime
from typing import Any, Literal, get_args

from sqlalchemy import ForeignKey, Index, LargeBinary, String, Text, UniqueConstraint, false, text
from sqlalchemy.orm import Mapped, mapped_column

from service.base.choices import RoleName
from service.store.columns import Base, now, one_of

STATES = ("queued", "running", "done", "failed", "cancelled")
ROLES: tuple[str, ...] = get_args(RoleName)


class JobRow(Base):
    """A background job; see `service.store.queue` for its states.

    - ``lease_token`` identifies the one worker that may write to the job until ``lease_until``.
    - ``revision`` counts visible changes.
    - ``arrays`` is the npz part of the result.
    - ``is_short`` jobs are expected to take seconds.
    - ``attempted_at`` is the start of the newest attempt.
    - ``attempts_before_progress`` counts the attempts before the one that last completed a step.
    - ``n_done`` of ``n_total`` units of the current ``phase`` are done.
    - ``remaining_s`` is the expected time to the end.
    """

    __tablename__ = "jobs"
    __table_args__ = (
        UniqueConstraint("created_by", "idempotency_key"),
        Index(None, "state", "not_before"),
        Index(None, "created_by", "attempted_at"),
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
    attempted_at: Mapped[datetime | None]
    attempts: Mapped[int] = mapped_column(default=0)
    attempts_before_progress: Mapped[int] = mapped_column(default=0, server_default="0")
    is_short: Mapped[bool] = mapped_column(default=False, server_default=false())
    cancel_requested: Mapped[bool] = mapped_column(default=False)
    progress: Mapped[float] = mapped_column(default=0.0)
    message: Mapped[str] = mapped_column(String(200), default="")
    phase: Mapped[str] = mapped_column(String(100), default="", server_default=text("''"))
    n_done: Mapped[int | None]
    n_total: Mapped[int | None]
    remaining_s: Mapped[float | None]
    revision: Mapped[int] = mapped_column(default=1)
    worker: Mapped[str | None] = mapped_column(String(96))
    lease_token: Mapped[str | None] = mapped_column(String(32))
    lease_until: Mapped[datetime | None]
    reason: Mapped[str | None] = mapped_column(String(1000))
    result: Mapped[dict[str, Any] | None]
    arrays: Mapped[bytes | None] = mapped_column(LargeBinary, deferred=True)


class JobStepRow(Base):
    """A completed step of a job, stored with its effects and never repeated.

    Both are stored in one transaction. ``arrays`` is the npz part of its result.
    """

    __tablename__ = "job_steps"

    job_id: Mapped[int] = mapped_column(ForeignKey("jobs.id"), primary_key=True)
    name: Mapped[str] = mapped_column(String(96), primary_key=True)
    result: Mapped[dict[str, Any]]
    arrays: Mapped[bytes | None] = mapped_column(LargeBinary, deferred=True)


class KeyRow(Base):
    """An API key by its hash.

    A withdrawn key remains, so that its name stays unambiguous in the audit trail. ``number``
    counts the keys of a name, which follow one another by rotation. ``last_used_at`` is kept to the
    hour.
    """

    __tablename__ = "api_keys"
    __table_args__ = (one_of("role", ROLES), UniqueConstraint("name", "number"))

    id: Mapped[int] = mapped_column(primary_key=True)
    name: Mapped[str] = mapped_column(String(64))
    number: Mapped[int] = mapped_column(default=1)
    prefix: Mapped[str] = mapped_column(String(16), unique=True)
    sha256: Mapped[str] = mapped_column(String(64))
    role: Mapped[str] = mapped_column(String(16))
    created_at: Mapped[datetime] = mapped_column(default=now)
    expires_at: Mapped[datetime | None]
    last_used_at: Mapped[datetime | None]
    withdrawn_at: Mapped[datetime | None]

    @property
    def state(self) -> Literal["valid", "expired", "withdrawn"]:
        """Whether it is valid now."""
        if self.withdrawn_at is not None:
            return "withdrawn"
        return "valid" if self.expires_at is None or self.expires_at > now() else "expired"


class SessionRow(Base):
    """A browser session by the hash of its token. The row is deleted when the session ends."""

    __tablename__ = "sessions"

    id: Mapped[int] = mapped_column(primary_key=True)
    key_id: Mapped[int] = mapped_column(ForeignKey("api_keys.id"), index=True)
    sha256: Mapped[str] = mapped_column(String(64), unique=True)
    created_at: Mapped[datetime] = mapped_column(default=now)
    expires_at: Mapped[datetime]


class AcknowledgementRow(Base):
    """An acknowledged alarm of a heliostat or of the plant (`service.twin.alarms.alarms`).

    It applies while the alarm's fingerprint equals ``fingerprint``, until somebody undoes it.
    Those of one ``batch`` were made together, with the reason ``comment``.
    """

    __tablename__ = "acknowledgements"

    id: Mapped[int] = mapped_column(primary_key=True)
    heliostat_id: Mapped[int | None] = mapped_column(ForeignKey("heliostats.id"), index=True)
    reason: Mapped[str] = mapped_column(String(32))
    fingerprint: Mapped[str] = mapped_column(String(96))
    made_at: Mapped[datetime] = mapped_column(default=now)
    made_by: Mapped[str] = mapped_column(String(64))
    batch: Mapped[int | None] = mapped_column(index=True)
    comment: Mapped[str] = mapped_column(String(200), default="", server_default=text("''"))
    undone_at: Mapped[datetime | None]
    undone_by: Mapped[str | None] = mapped_column(String(64))


class AlarmRow(Base):
    """An alarm of a heliostat or of the plant, from its beginning to its end.

    ``since`` and ``ended_at`` are times of the data; ``ended_at`` is None while it is present.
    ``recorded_at`` is when a worker first wrote it. ``measurements`` are identifiers of the
    heliostat's measurements to look at. ``offer`` is a `service.twin.alarms.offers.Offer`.
    """

    __tablename__ = "alarms"

    id: Mapped[int] = mapped_column(primary_key=True)
    heliostat_id: Mapped[int | None] = mapped_column(ForeignKey("heliostats.id"), index=True)
    reason: Mapped[str] = mapped_column(String(32))
    fingerprint: Mapped[str] = mapped_column(String(96))
    message: Mapped[str] = mapped_column(Text)
    action: Mapped[str] = mapped_column(Text)
    measurements: Mapped[list[str]]
    offer: Mapped[dict[str, object] | None]
    since: Mapped[datetime]
    recorded_at: Mapped[datetime] = mapped_column(default=now)
    ended_at: Mapped[datetime | None] = mapped_column(index=True)


class AuditRow(Base):
    """An entry of the audit trail: who did what, and when.

    Rows never change. Old ones are deleted (`service.store.deletion`).
    """

    __tablename__ = "audit"
    __table_args__ = (Index(None, "subject", "id"),)

    id: Mapped[int] = mapped_column(primary_key=True)
    created_at: Mapped[datetime] = mapped_column(default=now)
    actor: Mapped[str] = mapped_column(String(64))
    action: Mapped[str] = mapped_column(String(64))
    subject: Mapped[str] = mapped_column(String(128))
    detail: Mapped[dict[str, Any]]
