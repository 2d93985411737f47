"""Heliostats: REST, likely causes of poor forecasts, and the page of one."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from statistics import fmean
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Query, Request, Response, status
from fastapi.responses import HTMLResponse
from pydantic import BaseModel, Discriminator, Field, Tag
from sqlalchemy.orm import Session

from service import store
from service.base.arrays import unpack
from service.base.fields import HeliostatOf, Model, Name, Search, Version, from_row
from service.base.settings import Settings
from service.drawing import charts
from service.drawing.charts import HeatMap
from service.drawing.facets import FacetPlaces
from service.drawing.timelines import Timeline
from service.sources.heliostat_document import HeliostatDocument, HeliostatOfType
from service.sources.schema import HeliostatProperties
from service.store import acknowledgements, audit, decisions, mounts
from service.store.decisions import Justification, find_comparison
from service.store.listing import NEWEST_FIRST
from service.store.photographs import (
    PhotographFilter,
    PhotographGroup,
    PhotographVerdict,
    list_corrections,
    list_groups,
    newest_correction,
)
from service.store.rows import Put
from service.store.tables import CorrectionRow, DecisionRow, HeliostatRow, MountRow, SurfaceRow
from service.twin import plant_setup
from service.twin.alarms import causes
from service.twin.alarms.causes import (
    HeliostatFacts,
    LikelyCause,
    outlier_reasons,
    rank_causes,
    read_facts,
)
from service.twin.alarms.field_overview import (
    HeliostatOverview,
    field_totals,
    read_summaries,
    with_pointing,
)
from service.twin.calibration import CalibrationSlot, best_slot
from service.twin.forecasts.aims import plant_time_zone
from service.twin.plant_setup import Authorship
from service.twin.stored_mount import facet_places
from service.twin.surfaces.accuracy import ComparisonResult, rank_of
from service.web.auth.dependencies import (
    OPERATE,
    READ,
    AuthorshipDep,
    ComparisonCacheDep,
    Limit,
    NamePath,
    RenderSlotDep,
    RuntimeDep,
    require_json,
    set_tag,
)
from service.web.resources.alarms import AcknowledgementOut
from service.web.resources.heliostat_figures import (
    accuracy_over_time,
    accuracy_values,
    comparison_figures,
    draw_on_one_axis,
    histories,
    pointing_over_time,
    pointing_values,
    space_view,
    version_marks,
    versions,
)
from service.web.responses.lists import Page, page
from service.web.responses.openapi import problems
from service.web.responses.pages import render

_FORMS = {
    "heliostat_position": "(paint)",
    "format": "(document)",
    "position_m": "(document)",
    "type": "(type)",
    "east_m": "(type)",
}
"""Forms of a heliostat's properties by keys; the first key that is there decides."""


def _form(properties: Any) -> str:
    known = _FORMS.items() if isinstance(properties, dict) else ()
    return next((form for key, form in known if key in properties), "(paint)")


AnyHeliostat = Annotated[
    Annotated[HeliostatProperties, Tag("(paint)")]
    | Annotated[HeliostatOfType, Tag("(type)")]
    | Annotated[HeliostatDocument, Tag("(document)")],
    Discriminator(_form),
    Field(
        description=(
            "Its type and place in the terms of plant.yaml, or PAINT's properties, or what GET"
            " gives as `properties`."
        )
    ),
]


class HeliostatIn(Model):
    """A heliostat to store."""

    name: Name
    properties: AnyHeliostat


class HeliostatSummary(BaseModel):
    """A heliostat in a list."""

    name: HeliostatOf
    position_m: tuple[float, float, float] = Field(
        description="East, north, up of the tower base [m]."
    )


class HeliostatOut(HeliostatSummary):
    """A heliostat with its properties."""

    properties: dict[str, object] = Field(
        description=(
            "PAINT's as they were sent; of other heliostats a document with axes and facets. PUT"
            " takes both."
        )
    )
    updated_at: datetime = Field(description="When it was last changed.")


def heliostat_summary(row: HeliostatRow) -> HeliostatSummary:
    """A heliostat without its properties."""
    return from_row(HeliostatSummary, row, position_m=(row.east_m, row.north_m, row.up_m))


def heliostat_out(row: HeliostatRow) -> HeliostatOut:
    """A heliostat as JSON."""
    return from_row(HeliostatOut, row, position_m=(row.east_m, row.north_m, row.up_m))


def _set(
    session: Session,
    by: Authorship,
    name: str,
    given: HeliostatProperties | HeliostatOfType | HeliostatDocument,
    replace: bool = True,
) -> Put[HeliostatRow]:
    if isinstance(given, HeliostatOfType):
        return plant_setup.set_heliostat_of_type(session, by, name, given, replace)
    return plant_setup.set_heliostat(session, by, name, given.raw, replace)


router = APIRouter(tags=["heliostats"])
pages = APIRouter(include_in_schema=False)


@router.get("/heliostats", responses=problems(), dependencies=[READ])
def list_heliostats(
    runtime: RuntimeDep,
    limit: Limit = 100,
    after: Annotated[Name | None, Query(description="The last name of the page before.")] = None,
    prefix: Annotated[
        Name | None, Query(description="Only names that begin so, in capitals or not.")
    ] = None,
    search: Annotated[
        Search, Query(description="Only names with this in them, in capitals or not.")
    ] = "",
) -> Page[HeliostatSummary]:
    """List heliostats, in the order of their names. `/v1/field` filters them by their metrics."""
    with runtime.database.reading() as session:
        rows = store.list_heliostats(session, limit + 1, after, prefix, search)
    items = [heliostat_summary(row) for row in rows]
    return page(items, limit, "name")


@router.post(
    "/heliostats",
    status_code=status.HTTP_201_CREATED,
    responses={
        **problems(409, 413, 415),
        200: {"model": HeliostatOut, "description": "It was there already."},
    },
    dependencies=[OPERATE, Depends(require_json)],
)
def post_heliostat(
    request: HeliostatIn, runtime: RuntimeDep, by: AuthorshipDep, response: Response
) -> HeliostatOut:
    """Add a heliostat.

    The same heliostat again is no error. The same name with other properties is refused; use PUT.
    """
    row, change = runtime.database.run_in_transaction(
        lambda session: _set(session, by, request.name, request.properties, replace=False)
    )
    if change is store.Change.UNCHANGED:
        response.status_code = status.HTTP_200_OK
    else:
        response.headers["Location"] = f"/v1/heliostats/{request.name}"
    return heliostat_out(row)


@router.get("/heliostats/{name}", responses=problems(404), dependencies=[READ])
def get_heliostat(name: NamePath, runtime: RuntimeDep, response: Response) -> HeliostatOut:
    """Get a heliostat with its properties."""
    with runtime.database.reading() as session:
        set_tag(response, audit.version(session, f"heliostat {name}", "heliostat.set"))
        return heliostat_out(store.get_heliostat(session, name))


@router.put(
    "/heliostats/{name}",
    responses={
        **problems(409, 413, 415),
        201: {"model": HeliostatOut, "description": "It is new."},
    },
    dependencies=[OPERATE, Depends(require_json)],
)
def put_heliostat(
    name: NamePath,
    properties: AnyHeliostat,
    runtime: RuntimeDep,
    by: AuthorshipDep,
    response: Response,
) -> HeliostatOut:
    """Set a heliostat of any type.

    In the terms of plant.yaml it has a `type`, by its name in the imported plant.yaml or written
    out, and the place of its foot. PAINT's properties, and what GET gives as `properties`, are
    taken as well.
    """
    row, change = runtime.database.run_in_transaction(
        lambda session: _set(session, by, name, properties)
    )
    if change is store.Change.NEW:
        response.status_code = status.HTTP_201_CREATED
    return heliostat_out(row)


@router.delete(
    "/heliostats/{name}",
    status_code=status.HTTP_204_NO_CONTENT,
    response_class=Response,
    responses=problems(404, 409),
    dependencies=[OPERATE],
)
def delete_heliostat(name: NamePath, runtime: RuntimeDep, by: AuthorshipDep) -> None:
    """Delete a heliostat that was created by mistake.

    This is refused if photographs, surfaces or anything else refers to it.
    """
    runtime.database.run_in_transaction(
        lambda session: plant_setup.remove(session, by, "heliostat", name)
    )


class LikelyCausePage(Page[LikelyCause]):
    """Likely causes, the one that explains most first; none for a good heliostat."""

    pending: bool = Field(
        description="Whether photographs are still being compared; accuracies on arrival are used."
    )


@router.get("/heliostats/{name}/causes", responses=problems(404), dependencies=[READ])
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


# --- decisions on the page
# --------------------------------------------------------------------------------------------------


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
        is_newer = active is None or row.version > active.version
        if version is not None or (is_newer and decisions.is_undecided(session, row)):
            return SurfaceChoice(row, active, find_comparison(session, row, active))
    return None


# --- the page
# --------------------------------------------------------------------------------------------------

# Newest surfaces and photographs that the page lists.
MAX_SURFACES = 40
MAX_PHOTOGRAPHS = 60
"""Older photographs are on the page of all photographs."""
# Newest decisions on the active surface that the page lists.
_MAX_DECISIONS = 5


_UNDER_WAY = ComparisonResult(
    trouble="The forecasts of its photographs are being computed; reload the page in a moment."
)


def _surface_context(
    heliostat: HeliostatRow,
    surface: SurfaceRow,
    origin: tuple[float, float, float],
    ends: Mapping[str, float],
) -> dict[str, object]:
    arrays = unpack(surface.arrays)
    places = facet_places(heliostat, origin, len(arrays["z"]))
    shown = field_totals(surface.arrays)
    title = f"Surface {surface.version}: deviation from the ideal mirror, seen from the front"
    deviation = charts.surface_map(title, arrays["z"], places, ends["heights"])
    std = "Standard deviation of the surface"
    uncertainty = charts.uncertainty_map(std, arrays["z_std"], places, ends["height_std"])
    return {
        "figures": shown,
        "surface_map": deviation,
        "uncertainty_map": uncertainty if shown.uncertainty_mm else None,
        "space": space_view(arrays["z"], places, ends["heights"]),
    }


def _choice_maps(
    read: "_HeliostatData", choice: SurfaceChoice, ends: Mapping[str, float]
) -> list[HeatMap]:
    """The active surface, the candidate, and their difference."""
    n_facets = len(unpack(choice.candidate.arrays)["z"])
    return choice.maps(facet_places(read.heliostat, read.origin, n_facets), ends)


def _mount_context(mount: MountRow) -> dict[str, object]:
    """What the page shows of a mount: changes of its drives, and contradicting measurements."""
    return {
        "steps": [
            {"detail": ""}
            | step
            | {
                "from": datetime.fromisoformat(step["from"]),
                "to": datetime.fromisoformat(step["to"]),
            }
            for step in reversed(mount.document["steps"])
        ],
        **{
            name: mount.document[name]
            for name in ("drift", "outliers", "measurements", "predicted_error_mrad")
        },
    }


@dataclass(frozen=True)
class _HeliostatData:
    """Data of the page, read before the slot for drawing is taken.

    ``version`` is that of the photographs' corrections.
    """

    version: int
    heliostat: HeliostatRow
    origin: tuple[float, float, float]
    today: SurfaceRow | None
    surface: SurfaceRow | None
    surfaces: Sequence[SurfaceRow]
    decided: Sequence[DecisionRow]
    undoable: DecisionRow | None
    groups: list[PhotographGroup]
    verdict: PhotographVerdict | None
    mount: MountRow | None
    line: HeliostatOverview
    best: CalibrationSlot | None
    compared: ComparisonResult
    zone: str
    causes: list[causes.LikelyCause]
    evidence: OutlierEvidence | None
    exclusions: list[Exclusion]
    choice: SurfaceChoice | None
    acknowledgement: AcknowledgementOut | None


def _read(
    name: NamePath,
    runtime: RuntimeDep,
    cache: ComparisonCacheDep,
    version: Annotated[Version | None, Query()] = None,
    photographs: Annotated[PhotographVerdict | None, Query()] = None,
    candidate: Annotated[Version | None, Query()] = None,
) -> _HeliostatData:
    """Read a heliostat with its active surface, or an earlier ``version``.

    ``candidate`` is a version to decide on.

    It waits for comparisons that are computed in the background.
    """
    with runtime.database.reading() as session:
        correction = newest_correction(session)
        row, origin = store.get_heliostat(session, name), store.get_plant(session).origin
        today = store.find_surface_at(session, row)
        surface = today if version is None else store.get_surface(session, row, version)
        surfaces = store.list_surfaces(session, row, MAX_SURFACES, arrays=True, order=NEWEST_FIRST)
        decided = decisions.list_decisions(session, row, _MAX_DECISIONS)
        undoable = decisions.find_undoable(session, row)
        groups = list_groups(
            session, PhotographFilter(row, verdict=photographs), MAX_PHOTOGRAPHS + 1
        )
        mount = mounts.find_mount_at(session, row)
        exclusions = newest_exclusions(session, row)
        seen = acknowledgements.newest_batch(session, name, "untrusted")
        choice = find_choice(session, surfaces, today, candidate)
        shown, (line,) = cache.read(session, row, surface), read_summaries(session, row.id)
        zone = plant_time_zone(session, runtime.settings.time_zone)
    # The rest of the page does not depend on the comparisons.
    compared = ComparisonResult() if shown is None else cache.wait_for(shown) or _UNDER_WAY
    line = with_pointing(runtime, line)
    best = None if line.pointing is None else best_slot(runtime, name)
    likely, evidence = list[causes.LikelyCause](), None
    settings = runtime.settings
    with runtime.database.reading() as session:
        facts = causes.read_facts(session, line, row, surface, compared.comparisons, settings)
        if facts is not None:
            likely, evidence = causes.rank_causes(facts), outlier_evidence(facts)
    return _HeliostatData(
        correction,
        row,
        origin,
        today,
        surface,
        surfaces,
        decided,
        undoable,
        groups,
        photographs,
        mount,
        line,
        best,
        compared,
        zone,
        likely,
        evidence,
        exclusions,
        choice,
        AcknowledgementOut.of(seen) if seen else None,
    )


def _timelines(read: _HeliostatData, settings: Settings) -> list[Timeline]:
    """Accuracy by the shown surface and pointing error by the mount, over time."""
    surface = "ideal mirror" if read.surface is None else f"surface {read.surface.version}"
    mount = "" if read.mount is None else f"mount {read.mount.version}"
    charts = [
        accuracy_over_time({surface: accuracy_values(read.compared.comparisons)}, settings),
        pointing_over_time({mount: pointing_values(read.mount)}, settings),
    ]
    return draw_on_one_axis(charts, read.zone, version_marks(read.surfaces, "v"))


@pages.get("/heliostats/{name}", dependencies=[READ])
def get_heliostat_page(
    request: Request,
    runtime: RuntimeDep,
    read: Annotated[_HeliostatData, Depends(_read)],
    _slot: RenderSlotDep,
) -> HTMLResponse:
    """A heliostat with its active surface, or an earlier ``version``.

    The slot for drawing is not held while the comparisons are computed.
    """
    ends = runtime.settings.figure_scales
    listed, comparisons = versions(read.surfaces), read.compared.comparisons
    shown = vars(read) | {
        "size": read.heliostat.size_m,
        "versions": listed,
        "histories": histories(listed) if listed else [],
        "timelines": _timelines(read, runtime.settings),
        "comparisons": comparison_figures(comparisons, ends["flux_difference"]),
        "trouble": read.compared.trouble,
        "groups": read.groups[:MAX_PHOTOGRAPHS],
        "older": read.groups[MAX_PHOTOGRAPHS - 1].mark
        if len(read.groups) > MAX_PHOTOGRAPHS
        else None,
        "rank": rank_of(comparisons),
        "accuracy_seen": fmean(seen)
        if (seen := [c.accuracy for c in comparisons if c.was_used])
        else None,
        "choice_maps": None if read.choice is None else _choice_maps(read, read.choice, ends),
        "pointing": None if read.mount is None else _mount_context(read.mount),
    }
    if read.surface is not None:
        shown |= _surface_context(read.heliostat, read.surface, read.origin, ends)
    return render(request, "heliostat.html", **shown)
