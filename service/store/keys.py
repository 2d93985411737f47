"""API keys: made once, kept as a hash, withdrawn for good.

A key is ``htw_PREFIX_SECRET``. The secret is 256 random bits, so nobody can guess it or find it by trying hashes: a
plain SHA-256 is as safe as it is long, and the slow, salted hashes that passwords need would only slow every request.
The prefix is no secret; it finds the row, and tells people in lists and logs which key is meant.
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
from service.base.faults import ConflictError, NotFoundError
from service.store import audit
from service.store.columns import now
from service.store.job_tables import ROLES, KeyRow
from service.store.rows import insert

RESERVED = "local"
"""Who acts where no key is demanded; no key may bear this name."""

ITSELF = "the service"
"""Who acts where nobody asked; no key can bear this name, which holds a space, and so none can take its job's key."""

_KEY = re.compile(r"htw_([0-9a-f]{12})_([A-Za-z0-9_-]{43})")


def _sha256(key: str) -> str:
    return hashlib.sha256(key.encode()).hexdigest()


def create(session: Session, name: str, role: str, actor: str) -> str:
    """Make a key and return it; it is shown here once and cannot be read back.

    Raises
    ------
    InvalidInputError
        For a bad name or an unknown role.
    ConflictError
        Where the name was given before, even to a key that is withdrawn.
    """
    names.require(names.NAME, name, "key")
    if name == RESERVED:
        raise InvalidInputError(f"key {name!r}: this name stands for access without a key; choose another")
    if role not in ROLES:
        raise InvalidInputError(f"role {role!r}: must be one of {', '.join(ROLES)}")
    prefix = secrets.token_hex(6)
    key = f"htw_{prefix}_{secrets.token_urlsafe(32)}"
    if not insert(session, KeyRow(name=name, prefix=prefix, sha256=_sha256(key), role=role)):
        raise ConflictError(f"there is, or was, a key {name}; choose another name")
    audit.record(session, actor, "key.created", f"key {name}", role=role)
    return key


def withdraw(session: Session, name: str, actor: str) -> None:
    """Make a key useless from now on; NotFoundError where there is none, or it is withdrawn already."""
    row = session.scalar(select(KeyRow).where(KeyRow.name == name, KeyRow.withdrawn_at.is_(None)).with_for_update())
    if row is None:
        raise NotFoundError(f"there is no key {name}, or it is withdrawn already")
    row.withdrawn_at = now()
    audit.record(session, actor, "key.withdrawn", f"key {name}")


def list_keys(session: Session) -> Sequence[KeyRow]:
    """All keys in the order they were made, withdrawn ones too."""
    return session.scalars(select(KeyRow).order_by(KeyRow.id)).all()


def find(session: Session, presented: str) -> KeyRow | None:
    """The key that was presented, unless it is malformed, unknown or withdrawn."""
    match = _KEY.fullmatch(presented)
    if match is None:
        return None
    row = session.scalar(select(KeyRow).where(KeyRow.prefix == match[1], KeyRow.withdrawn_at.is_(None)))
    if row is None or not hmac.compare_digest(row.sha256, _sha256(presented)):
        return None
    return row


def any_made(session: Session) -> bool:
    """Whether a key was ever made: from then on nobody comes in without one, even when all are withdrawn."""
    return session.scalar(select(KeyRow.id).limit(1)) is not None


def any_valid(session: Session) -> bool:
    """Whether there is a key that opens something."""
    return session.scalar(select(KeyRow.id).where(KeyRow.withdrawn_at.is_(None)).limit(1)) is not None
