"""Delete a photograph, and image files that nothing else needs."""

from service.store import deletion, image_files
from service.store.deletion import Deleted
from service.twin.runtime import Runtime


def delete_photograph(
    runtime: Runtime,
    heliostat: str,
    identifier: str,
    reason: str,
    actor: str,
    only_this: bool = False,
) -> Deleted:
    """Delete a photograph and then its files.

    See `service.store.deletion.delete_photograph`. During a back-up the
    files stay until the job `prunings` removes them.
    """
    deleted = runtime.database.run_in_transaction(
        lambda session: deletion.delete_photograph(
            session, heliostat, identifier, reason, actor, only_this
        )
    )
    with runtime.images.removing() as is_free:
        if is_free:
            with runtime.database.writing() as session:
                image_files.remove_marked(session, runtime.images)
    return deleted
