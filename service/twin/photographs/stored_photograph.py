"""A stored photograph: its pixels, target outline, comparison with the forecast, and deletion."""

from collections.abc import Iterator
from contextlib import contextmanager

from service import store
from service.base.errors import NotFoundError
from service.sources.decode import Pixels
from service.store import deletion, image_files
from service.store.deletion import Deleted
from service.store.tables import MeasurementRow
from service.twin.measurements import load_heliostat_context
from service.twin.photographs.ingest import MeasuredImage, measure_stored
from service.twin.photographs.metadata import photograph_from_row
from service.twin.runtime import Runtime
from service.twin.surfaces.accuracy import PhotographComparison, compare_with


@contextmanager
def pixels_of(runtime: Runtime, row: MeasurementRow) -> Iterator[Pixels]:
    """Decode a stored image for the block; NotFoundError if the measurement has none."""
    if row.image_sha256 is None:
        raise NotFoundError(f"measurement {row.identifier} came without an image")
    data = runtime.images.read(row.image_sha256)
    with runtime.decoded(data) as pixels:
        yield pixels


def load_for_display(runtime: Runtime, heliostat: str, row: MeasurementRow) -> MeasuredImage:
    """Pixels of a stored photograph, and its flux re-measured from them.

    The flux includes the target's outline and the crop, which are not stored.
    """
    with runtime.database.reading() as session:
        twin = load_heliostat_context(session, heliostat)
    return measure_stored(
        runtime, row, photograph_from_row(row), twin, store.target_plane(row.target)
    )


def compare_one(runtime: Runtime, heliostat: str, identifier: str) -> PhotographComparison:
    """Compare a photograph with the forecast of the active surface and the current model.

    Raises
    ------
    NotFoundError
        If the photograph was refused or came without an image, so that it has no flux.
    """
    with runtime.database.reading() as session:
        twin = load_heliostat_context(session, heliostat)
        row = store.get_measurement(session, twin.row, identifier, arrays=True)
        surface = store.find_surface_at(session, twin.row)
    if row.image_sha256 is None:
        raise NotFoundError(f"measurement {identifier} came without an image, so it has no flux")
    if row.arrays is None:
        raise NotFoundError(
            f"measurement {identifier} was refused ({row.reason}), so it has no flux"
        )
    return compare_with(runtime, twin, surface, [row])[0]


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
