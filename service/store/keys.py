"""API keys: shown once, stored as a hash, rotated, withdrawn permanently.

A key is ``htw_PREFIX_SECRET``. The secret has 256 random bits, so nobody can guess it. A plain
SHA-256 is therefore safe, and the slow, salted hashes that passwords need would only slow down
requests. The prefix is not secret: it finds the row, and identifies the key in lists and logs.
"""

import hashlib
import hmac
import re
import secrets
from collections.abc import Sequence
from datetime import timedelta

from sqlalchemy import select, update
from sqlalchemy.orm import Session

from model.errors import InvalidInputError
from service.base import validation
from service.base.errors import ConflictError, NotFoundError
from service.store import audit, sessions
from service.store.columns import now
from service.store.database import Database
from service.store.job_tables import ROLES, KeyRow
from service.store.rows import insert

RESERVED = "local"
"""The actor if no key is required. No key may have this name."""

ITSELF = "the service"
"""The actor of the service's automatic actions.

No key can have this name, because it contains a space. So no key can use its idempotency keys.
"""

NOBODY = "without a key"
"""The actor of refused logins. No key can have this name."""

_KEY = re.compile(r"htw_([0-9a-f]{12})_([A-Za-z0-9_-]{43})")


def _sha256(key: str) -> str:
    return hashlib.sha256(key.encode()).hexdigest()


def create(
    session: Session, name: str, role: str, actor: str, lasts: timedelta | None = None
) -> str:
    """Create a key and return it. It cannot be read again later. It ``lasts`` without end if None.

    Raises
    ------
    InvalidInputError
        For an invalid name or an unknown role.
    ConflictError
        If a key has or had this name, even if it is withdrawn.
    """
    validation.require_name(validation.NAME, name, "key")
    if name == RESERVED:
        raise InvalidInputError(
            f"key {name!r}: this name is reserved for access without a key; choose another"
        )
    if role not in ROLES:
        raise InvalidInputError(f"role {role!r}: must be one of {', '.join(ROLES)}")
    key = _insert(session, name, role, 1, lasts)
    audit.record(session, actor, "key.created", f"key {name}", role=role)
    return key


def _insert(session: Session, name: str, role: str, number: int, lasts: timedelta | None) -> str:
    prefix, at = secrets.token_hex(6), now()
    key = f"htw_{prefix}_{secrets.token_urlsafe(32)}"
    row = KeyRow(name=name, number=number, prefix=prefix, sha256=_sha256(key), role=role)
    row.created_at, row.expires_at = at, None if lasts is None else at + lasts
    if not insert(session, row):
        raise ConflictError(f"there is, or was, a key {name}; choose another name, or rotate it")
    return key


def rotate(session: Session, name: str, actor: str, overlap: timedelta) -> str:
    """Create the next key of a name and return it; the former one is valid for ``overlap`` longer.

    It has the role of the former key, and lasts as long.

    Raises
    ------
    NotFoundError
        If no key of this name is valid.
    ConflictError
        If two are valid, because it was rotated just now.
    """
    rows = _valid(session, name)
    if len(rows) > 1:
        raise ConflictError(
            f"key {name} was rotated already, and two are valid; withdraw the former one first, by"
            f" `heliotwin keys withdraw {name} --former`"
        )
    (former,) = rows
    lasts = None if former.expires_at is None else former.expires_at - former.created_at
    ends = now() + overlap
    former.expires_at = ends if former.expires_at is None else min(ends, former.expires_at)
    key = _insert(session, name, former.role, former.number + 1, lasts)
    audit.record(session, actor, "key.rotated", f"key {name}", former=former.prefix)
    return key


def withdraw(session: Session, name: str, actor: str, former: bool = False) -> None:
    """Withdraw the keys of a name and end their sessions; of ``former`` ones the newest remains.

    Raises
    ------
    NotFoundError
        If no such key is valid.
    """
    rows = _valid(session, name)[: -1 if former else None]
    if not rows:
        raise NotFoundError(f"key {name} has no former key that is valid")
    for row in rows:
        row.withdrawn_at = now()
        sessions.end_all(session, row)
    about = {"former": rows[0].prefix} if former else {}
    audit.record(session, actor, "key.withdrawn", f"key {name}", **about)


def _valid(session: Session, name: str) -> Sequence[KeyRow]:
    query = sessions.valid_keys().where(KeyRow.name == name).order_by(KeyRow.number)
    rows = session.scalars(query.with_for_update()).all()
    if not rows:
        raise NotFoundError(f"no key {name} is valid: there is none, it expired or is withdrawn")
    return rows


_USE_EVERY = timedelta(hours=1)


def is_use_due(row: KeyRow) -> bool:
    """Whether a use of the key is to be recorded: at most once an hour, as it is a write."""
    return row.last_used_at is None or now() - row.last_used_at > _USE_EVERY


def record_use(database: Database, number: int) -> None:
    """Record that the key of this id is used now."""
    with database.writing() as session:
        session.execute(update(KeyRow).where(KeyRow.id == number).values(last_used_at=now()))


def list_keys(session: Session) -> Sequence[KeyRow]:
    """All keys in the order of their creation, including withdrawn ones."""
    return session.scalars(select(KeyRow).order_by(KeyRow.id)).all()


def find(session: Session, presented: str) -> KeyRow | None:
    """The row of a presented key; None if it is malformed, unknown, expired or withdrawn."""
    match = _KEY.fullmatch(presented)
    if match is None:
        return None
    row = session.scalar(sessions.valid_keys().where(KeyRow.prefix == match[1]))
    if row is None or not hmac.compare_digest(row.sha256, _sha256(presented)):
        return None
    return row


def prefix_of(presented: str) -> str | None:
    """The prefix of a presented key, which `list_keys` shows; None if it is malformed."""
    match = _KEY.fullmatch(presented)
    return None if match is None else match[1]


def any_made(session: Session) -> bool:
    """Whether a key was ever created. From then on every request needs one, even if all are
    withdrawn.
    """
    return session.scalar(select(KeyRow.id).limit(1)) is not None


def any_valid(session: Session) -> bool:
    """Whether there is a valid key."""
    return session.scalar(sessions.valid_keys().limit(1)) is not None
