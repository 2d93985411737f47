"""Photographs that make a heliostat bad, and the candidate that waits for a decision."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sqlalchemy import select
from sqlalchemy.orm import Session

from service.base.arrays import unpack
from service.drawing import charts
from service.drawing.charts import HeatMap
from service.drawing.facets import FacetPlaces
from service.store.photographs.correction_log import list_corrections
from service.store.photographs.groups import PhotographFilter, list_groups
from service.store.surfaces.decisions import Justification, find_comparison
from service.store.tables import CorrectionRow, DecisionRow, HeliostatRow, SurfaceRow
from service.twin.alarms.causes import HeliostatFacts, outlier_reasons

# Newest excluded photographs that can be used again from the page.
_MAX_EXCLUDED = 5


@dataclass(frozen=True)
class Exclusion:
    """An excluded photograph, and the correction that excluded it."""

    identifier: str
    correction: CorrectionRow


def newest_exclusions(session: Session, heliostat: HeliostatRow) -> list[Exclusion]:
    """Excluded photographs of a heliostat with their reasons, newest first."""
    groups = list_groups(session, PhotographFilter(heliostat, verdict="excluded"), _MAX_EXCLUDED)
    found = ((group.best, list_corrections(session, group.best)) for group in groups)
    return [Exclusion(row.identifier, corrections[-1]) for row, corrections in found if corrections]


@dataclass(frozen=True)
class OutlierEvidence:
    """Reasons of outliers by identifier; ``is_minority`` is whether most photographs are none."""

    reasons: Mapping[str, str]
    is_minority: bool


def outlier_evidence(facts: HeliostatFacts) -> OutlierEvidence:
    """The photographs that make a heliostat bad, and whether excluding all of them makes sense."""
    reasons = outlier_reasons(facts)
    return OutlierEvidence(reasons, 2 * len(reasons) <= len(facts.photographs))


@dataclass(frozen=True, eq=False)
class SurfaceChoice:
    """A candidate and the active surface, which is None for the ideal mirror.

    ``evaluation`` is the last comparison of the two.
    """

    candidate: SurfaceRow
    active: SurfaceRow | None
    evaluation: Justification | None

    def maps(self, places: FacetPlaces, ends: Mapping[str, float]) -> list[HeatMap]:
        """Both surfaces on one scale, and the candidate minus the active one if it fits."""
        rows = [row for row in (self.active, self.candidate) if row is not None]
        heights = [unpack(row.arrays)["z"] for row in rows]
        drawn = [
            charts.surface_map(f"Deviation of version {row.version}", z, places, ends["heights"])
            for row, z in zip(rows, heights, strict=True)
            if len(z) == len(heights[-1])
        ]
        if len(drawn) < 2 or heights[0].shape != heights[1].shape:
            return drawn
        title = f"Version {rows[1].version} minus version {rows[0].version}"
        change = heights[1] - heights[0]
        return [*drawn, charts.surface_map(title, change, places, ends["height_change"])]


def find_choice(
    session: Session, surfaces: Sequence[SurfaceRow], active: SurfaceRow | None, version: int | None
) -> SurfaceChoice | None:
    """The candidate of this ``version``, else the newest one on which nobody has decided.

    ``surfaces`` are a heliostat's newest ones, with their arrays, newest first. A candidate that is
    older than the active surface waits for nothing.
    """
    for row in surfaces:
        if not row.is_candidate or version not in (None, row.version):
            continue
        query = select(DecisionRow).where(DecisionRow.surface_id == row.id)
        found = session.scalars(query.order_by(DecisionRow.id.desc()).limit(2)).all()
        is_new = len(found) < 2 and (active is None or row.version > active.version)
        if version is not None or is_new:
            return SurfaceChoice(row, active, find_comparison(session, row, active))
    return None
