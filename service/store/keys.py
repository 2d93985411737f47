"""API keys: shown once, stored as a hash, withdrawn permanently.

A key is ``htw_PREFIX_SECRET``. The secret has 256 random bits, so nobody can guess it. A plain
SHA-256 is therefore safe, and the slow, salted hashes that passwords need would only slow down
requests. The prefix is not secret: it finds the row, and identifies the key in lists and logs.
"""

import hashlib
import hmac
import re
import secrets
from collections.abc import Sequence

from sqlalchemy import select
from sqlalchemy.orm import Session

from model.errors import InvalidInputError
from service.base import names
from service.base.errors import ConflictError, NotFoundError
from service.store import audit, sessions
from service.store.columns import now
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


def create(session: Session, name: str, role: str, actor: str) -> str:
    """Create a key and return it. It cannot be read again later.

    Raises
    ------
    InvalidInputError
        For an invalid name or an unknown role.
    ConflictError
        If a key has or had this name, even if it is withdrawn.
    """
    names.require_name(names.NAME, name, "key")
    if name == RESERVED:
        raise InvalidInputError(
            f"key {name!r}: this name is reserved for access without a key; choose another"
        )
    if role not in ROLES:
        raise InvalidInputError(f"role {role!r}: must be one of {', '.join(ROLES)}")
    prefix = secrets.token_hex(6)
    key = f"htw_{prefix}_{secrets.token_urlsafe(32)}"
    if not insert(session, KeyRow(name=name, prefix=prefix, sha256=_sha256(key), role=role)):
        raise ConflictError(f"there is, or was, a key {name}; choose another name")
    audit.record(session, actor, "key.created", f"key {name}", role=role)
    return key


def withdraw(session: Session, name: str, actor: str) -> None:
    """Withdraw a key and end its sessions.

    Raises
    ------
    NotFoundError
        If there is no such key, or it is already withdrawn.
    """
    row = session.scalar(
        select(KeyRow).where(KeyRow.name == name, KeyRow.withdrawn_at.is_(None)).with_for_update()
    )
    if row is None:
        raise NotFoundError(f"there is no key {name}, or it is withdrawn already")
    row.withdrawn_at = now()
    sessions.end_all(session, row)
    audit.record(session, actor, "key.withdrawn", f"key {name}")


def list_keys(session: Session) -> Sequence[KeyRow]:
    """All keys in the order of their creation, including withdrawn ones."""
    return session.scalars(select(KeyRow).order_by(KeyRow.id)).all()


def find(session: Session, presented: str) -> KeyRow | None:
    """The row of a presented key; None if the key is malformed, unknown or withdrawn."""
    match = _KEY.fullmatch(presented)
    if match is None:
        return None
    row = session.scalar(
        select(KeyRow).where(KeyRow.prefix == match[1], KeyRow.withdrawn_at.is_(None))
    )
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
    return (
        session.scalar(select(KeyRow.id).where(KeyRow.withdrawn_at.is_(None)).limit(1)) is not None
    )
