"""Likely causes of a heliostat's poor forecasts."""

from fastapi import APIRouter
from pydantic import Field

from service import store
from service.twin.alarms.causes import LikelyCause, rank_causes, read_facts
from service.twin.alarms.field_overview import read_summaries, with_pointing
from service.twin.surfaces.accuracy import ComparisonResult
from service.web.auth.dependencies import READ, ComparisonCacheDep, NamePath, RuntimeDep
from service.web.responses.openapi import problems
from service.web.responses.paging import Page

router = APIRouter(prefix="/heliostats/{name}/causes", tags=["heliostats"])


class LikelyCausePage(Page[LikelyCause]):
    """Likely causes, the one that explains most first; none for a good heliostat."""

    pending: bool = Field(
        description="Whether photographs are still being compared; accuracies on arrival are used."
    )


@router.get("", responses=problems(404), dependencies=[READ])
def list_causes(name: NamePath, runtime: RuntimeDep, cache: ComparisonCacheDep) -> LikelyCausePage:
    """Rank the likely causes of a heliostat's poor forecasts."""
    with runtime.database.reading() as session:
        row = store.get_heliostat(session, name)
        surface = store.find_surface_at(session, row)
        key, (line,) = cache.read(session, row, surface), read_summaries(session, row.id)
    compared = ComparisonResult() if key is None else cache.wait_for(key)
    line = with_pointing(runtime, line)
    comparisons = () if compared is None else compared.comparisons
    with runtime.database.reading() as session:
        facts = read_facts(session, line, row, surface, comparisons, runtime.settings)
        found = [] if facts is None else rank_causes(facts)
    return LikelyCausePage(items=found, next=None, pending=compared is None)
