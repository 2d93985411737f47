"""The job `prunings`: delete images that are too old or beyond the quota. Workers start it."""

from collections import Counter

from sqlalchemy.orm import Session

from service.base.fields import Model
from service.base.settings import Settings
from service.jobs.kind import Context, Kind, Result
from service.store import image_files, queue
from service.store.image_files import RetentionRule


class PruningsIn(Model):
    """Delete images according to the settings. There are no options."""


def prune(context: Context, _payload: PruningsIn) -> Result:
    """Mark, then delete images. After a restart the job continues with the remaining ones."""
    settings, counts, size = context.runtime.settings, Counter[str](), 0
    with context.runtime.database.reading() as session:
        found = image_files.retention_rules(session, settings)
    for index, rule in enumerate(found):
        what = f"{rule.name}, {rule.reason}"
        context.report(index / len(found), what, phase="rules", n_done=index, n_total=len(found))
        size += _give_up(context, rule, counts)
    removed = _remove(context)
    with context.runtime.database.reading() as session:
        waiting = image_files.has_marked(session)
    note = {"note": "a back-up is being made; files go after it"} if waiting else {}
    return Result(
        {
            "images": counts.total(),
            "bytes": size,
            "files_removed": removed,
            "counts": dict(counts),
            **note,
        }
    )


def _give_up(context: Context, rule: RetentionRule, counts: Counter[str]) -> int:
    """Mark all images that match a rule, and return their size [bytes]."""
    size, last = 0, None
    while True:
        with context.runtime.database.writing() as session:
            batch = image_files.mark_for_deletion(
                session, context.runtime.settings, rule, context.created_by, last
            )
        if batch is None:
            return size
        counts[f"{rule.name}, {rule.reason}"] += batch.images
        size, last = size + batch.size_bytes, batch.last
        context.check()


def _remove(context: Context) -> int:
    """Delete the files of all marked images until a back-up begins, and return their number."""
    database, images, removed = context.runtime.database, context.runtime.images, 0
    while True:
        with images.removing() as is_free, database.writing() as session:
            count = image_files.remove_marked(session, images) if is_free else 0
        if not count:
            return removed
        removed += count
        context.report(0.9, f"{removed} files removed", phase="files")


def due(session: Session, settings: Settings) -> str | None:
    """The key of a due job, or None.

    A job is due once a day for old images. It is due once an hour while the quota is exceeded or
    files wait for the end of a back-up.
    """
    rules, at = image_files.retention_rules(session, settings), queue.database_time(session)
    old = [rule for rule in rules if rule.reason == "age"]
    beyond = [rule for rule in rules if rule.reason == "quota"]
    if image_files.has_marked(session) or (
        image_files.excess_bytes(session, settings) and image_files.has_candidates(session, beyond)
    ):
        return f"prunings-{at:%Y-%m-%dT%H}"
    return f"prunings-{at:%Y-%m-%d}" if image_files.has_candidates(session, old) else None


KIND = Kind(
    "prunings", PruningsIn, prune, "Delete images that are too old or beyond the quota.", due
)
