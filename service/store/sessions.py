"""Browser sessions: started with a key, stored as a hash.

A session ends by logging out, by expiry, or with its key. The browser's cookie holds a random token
that is valid for half a day, and never the key.
"""

import hashlib
import re
import secrets
from datetime import timedelta

from sqlalchemy import Select, delete, select
from sqlalchemy.orm import Session

from service.store.columns import now
from service.store.job_tables import KeyRow, SessionRow

LASTS = timedelta(hours=12)
"""Lifetime of a session."""

# Maximum sessions of a key. The oldest ones end if more begin.
_MOST = 100

_TOKEN = re.compile(r"hts_[A-Za-z0-9_-]{43}")


def _sha256(token: str) -> str:
    return hashlib.sha256(token.encode()).hexdigest()


def is_token(presented: str) -> bool:
    """Whether a string has the form of a session token."""
    return _TOKEN.fullmatch(presented) is not None


def begin(session: Session, key: KeyRow) -> str:
    """Begin a session with a key and return its token. Expired sessions are deleted."""
    at, token = now(), f"hts_{secrets.token_urlsafe(32)}"
    session.execute(delete(SessionRow).where(SessionRow.expires_at <= at))
    session.add(
        SessionRow(key_id=key.id, sha256=_sha256(token), created_at=at, expires_at=at + LASTS)
    )
    session.flush()
    newest = (
        select(SessionRow.id)
        .where(SessionRow.key_id == key.id)
        .order_by(SessionRow.id.desc())
        .limit(_MOST)
    )
    kept = session.scalars(newest).all()
    session.execute(
        delete(SessionRow).where(SessionRow.key_id == key.id, SessionRow.id.not_in(kept))
    )
    return token


def valid_keys() -> Select[KeyRow]:
    """Select the keys that are neither withdrawn nor expired."""
    is_lasting = KeyRow.expires_at.is_(None) | (KeyRow.expires_at > now())
    return select(KeyRow).where(KeyRow.withdrawn_at.is_(None), is_lasting)


def find_key(session: Session, token: str) -> KeyRow | None:
    """The key of a session; None if the session has ended, or the key is no longer valid."""
    if not is_token(token):
        return None
    query = valid_keys().join(SessionRow, SessionRow.key_id == KeyRow.id)
    return session.scalar(
        query.where(SessionRow.sha256 == _sha256(token), SessionRow.expires_at > now())
    )


def end(session: Session, token: str) -> None:
    """End a session. Does nothing if it has already ended."""
    session.execute(delete(SessionRow).where(SessionRow.sha256 == _sha256(token)))


def end_all(session: Session, key: KeyRow) -> None:
    """End all sessions of a key."""
    session.execute(delete(SessionRow).where(SessionRow.key_id == key.id))
