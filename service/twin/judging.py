"""Whether a new surface is better than today's: both held against the same photographs, ones that neither has seen."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from statistics import fmean

from model.metrics import flux_accuracy
from service.store.decisions import Grounds
from service.store.tables import MeasurementRow, SurfaceRow
from service.twin.accuracy import forecasts_of, name_of, seen_by, unseen_first
from service.twin.evidence import Array, Twin, evidence_of, heights_of
from service.twin.runtime import Runtime


@dataclass(frozen=True)
class Judgement:
    """Whether a new surface takes the place of the one that is today's, which has version ``against``."""

    against: int
    taken: bool
    grounds: Grounds


def judge_surface(
    runtime: Runtime, twin: Twin, today: SurfaceRow, z: Array, used: Collection[MeasurementRow]
) -> Judgement:
    """Hold heights ``z`` (4, 8, 8) [m], found from photographs ``used``, against today's surface.

    Photographs that neither has seen judge. Where there are none all do, which flatter both alike; but against a
    surface that was measured, and has seen none, they prove nothing.
    """
    with runtime.database.reading() as session:
        rows, unseen = unseen_first(session, twin.row, seen_by(today) | {name_of(row) for row in used})
    if not unseen and not today.measurements:
        reason = f"version {today.version} was measured, and no photograph that this one has not seen tells it worse"
        return Judgement(today.version, False, Grounds(reason))
    rows = rows[:unseen] if unseen else rows
    before, after = (_accuracy(runtime, twin, rows, heights) for heights in (heights_of(today), z))
    taken = after >= before
    said = "forecasts no worse" if taken else "forecasts worse"
    which = "photographs that neither has seen" if unseen else "photographs, none of them unseen"
    return Judgement(
        today.version,
        taken,
        Grounds(f"{said} than version {today.version} on {len(rows)} {which}", before, after, len(rows)),
    )


def _accuracy(runtime: Runtime, twin: Twin, rows: Sequence[MeasurementRow], z: Array | None) -> float:
    shown = [evidence_of(row, twin.origin) for row in rows]
    forecasts = forecasts_of(runtime, twin, shown, z)
    return fmean(flux_accuracy(e.centered, forecast) for e, forecast in zip(shown, forecasts, strict=True))
