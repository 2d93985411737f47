"""A photograph as people look at it: its pixels, where its target was found, and what today's twin forecasts."""

from model.imaging import MeasuredFlux
from service import store
from service.base.faults import NotFoundError
from service.sources.decode import Pixels, decode_image
from service.store.tables import MeasurementRow
from service.twin.accuracy import Comparison, compare_with
from service.twin.evidence import load_twin
from service.twin.ingest import measure_stored
from service.twin.photographs import photograph_of
from service.twin.runtime import Runtime


def pixels_of(runtime: Runtime, row: MeasurementRow) -> Pixels:
    """The pixels of a stored image."""
    data = runtime.images.read(row.image_sha256)
    return decode_image(data, max_pixels=runtime.settings.max_image_pixels)


def look_at(runtime: Runtime, heliostat: str, row: MeasurementRow) -> tuple[Pixels, MeasuredFlux]:
    """A stored photograph's pixels and what is measured in it, with what is not kept: the outline and the crop."""
    with runtime.database.reading() as session:
        twin = load_twin(session, heliostat)
    return measure_stored(runtime, row, photograph_of(row), twin, store.target_plane(row.target))


def compare_one(runtime: Runtime, heliostat: str, identifier: str) -> Comparison:
    """A photograph against the forecast by today's surface and model.

    Raises
    ------
    NotFoundError
        Where it was not accepted, and shows no light.
    """
    with runtime.database.reading() as session:
        twin = load_twin(session, heliostat)
        row = store.get_measurement(session, twin.row, identifier, arrays=True)
        surface = store.find_surface_at(session, twin.row)
    if row.arrays is None:
        raise NotFoundError(f"measurement {identifier} was refused ({row.reason}), so it has no flux")
    return compare_with(runtime, twin, surface, [row])[0]
