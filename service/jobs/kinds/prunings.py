"""The job `prunings`: photographs' images that are too old, or beyond the quota, make room. Workers begin it."""

from collections import Counter

from sqlalchemy.orm import Session

from service.base.fields import Model
from service.base.settings import Settings
from service.jobs.kind import Context, Kind, Result
from service.store import photographs, queue
from service.store.photographs import Rule


class PruningsIn(Model):
    """Give up images as the settings say; there is nothing to choose."""


def prune(context: Context, _payload: PruningsIn) -> Result:
    """Mark, then remove; begun again it goes on with what is left."""
    settings, counts, size = context.runtime.settings, Counter[str](), 0
    with context.runtime.database.reading() as session:
        found = photographs.rules(session, settings)
    for index, rule in enumerate(found):
        context.report(index / len(found), f"{rule.name}, {rule.reason}")
        size += _give_up(context, rule, counts)
    removed = _remove(context)
    with context.runtime.database.reading() as session:
        waiting = photographs.has_marked(session)
    note = {"note": "a back-up is being made; files go after it"} if waiting else {}
    return Result({"images": counts.total(), "bytes": size, "files_removed": removed, "counts": dict(counts), **note})


def _give_up(context: Context, rule: Rule, counts: Counter[str]) -> int:
    """All that a rule finds; how many bytes that is."""
    size, last = 0, None
    while True:
        with context.runtime.database.writing() as session:
            batch = photographs.give_up(session, context.runtime.settings, rule, context.created_by, last)
        if batch is None:
            return size
        counts[f"{rule.name}, {rule.reason}"] += batch.images
        size, last = size + batch.size_bytes, batch.last
        context.check()


def _remove(context: Context) -> int:
    """The files of all marked images, until a back-up begins; how many."""
    database, images, removed = context.runtime.database, context.runtime.images, 0
    while True:
        with images.removing() as is_free, database.writing() as session:
            count = photographs.remove(session, images) if is_free else 0
        if not count:
            return removed
        removed += count
        context.report(0.9, f"{removed} files removed")


def due(session: Session, settings: Settings) -> str | None:
    """Once a day for what is too old; once an hour while the quota is exceeded, or files wait for a back-up's end."""
    rules, at = photographs.rules(session, settings), queue.clock(session)
    old = [rule for rule in rules if rule.reason == "age"]
    beyond = [rule for rule in rules if rule.reason == "quota"]
    if photographs.has_marked(session) or (
        photographs.excess_bytes(session, settings) and photographs.has_some(session, beyond)
    ):
        return f"prunings-{at:%Y-%m-%dT%H}"
    return f"prunings-{at:%Y-%m-%d}" if photographs.has_some(session, old) else None


KIND = Kind("prunings", PruningsIn, prune, "Give up images that are too old or beyond the quota.", due)
