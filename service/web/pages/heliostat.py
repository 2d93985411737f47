"""Page of a heliostat: surface map, 3D view, history, forecast comparisons and photographs."""

import itertools
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from statistics import fmean
from typing import Annotated, Any, ClassVar

import numpy as np
from fastapi import APIRouter, Depends, Query, Request
from fastapi.responses import HTMLResponse
from numpy.typing import NDArray
from sqlalchemy import select
from sqlalchemy.orm import Session, undefer

from model.plant import inside_outline
from service import store
from service.base.arrays import unpack
from service.base.fields import Version
from service.base.settings import Settings
from service.drawing import charts
from service.drawing.charts import ColourScale, HeatMap, History
from service.drawing.facets import FacetPlaces
from service.drawing.pictures import comparison_picture, mirror_heights
from service.drawing.timelines import Timeline
from service.store import acknowledgements
from service.store.photographs.correction_log import newest_correction
from service.store.photographs.groups import (
    PhotographFilter,
    PhotographGroup,
    PhotographVerdict,
    list_groups,
)
from service.store.pointing import mounts
from service.store.surfaces import decisions
from service.store.tables import DecisionRow, HeliostatRow, MountRow, SurfaceRow
from service.twin.alarms import causes
from service.twin.alarms.field_overview import (
    FieldTotals,
    HeliostatOverview,
    field_totals,
    read_summaries,
    with_pointing,
)
from service.twin.forecasts.aim_sources import plant_time_zone
from service.twin.heliostats.facets import facet_places
from service.twin.pointing.calibration import CalibrationSlot, best_slot
from service.twin.surfaces.accuracy import ComparisonResult, PhotographComparison, rank_of
from service.web.auth.dependencies import (
    READ,
    ComparisonCacheDep,
    NamePath,
    RenderSlotDep,
    RuntimeDep,
)
from service.web.pages.heliostat_charts import (
    accuracy_over_time,
    accuracy_values,
    draw_on_one_axis,
    pointing_over_time,
    pointing_values,
    version_marks,
)
from service.web.pages.heliostat_decision import (
    Exclusion,
    OutlierEvidence,
    SurfaceChoice,
    find_choice,
    newest_exclusions,
    outlier_evidence,
)
from service.web.resources.alarms import AcknowledgementOut
from service.web.responses.pages import render

router = APIRouter(include_in_schema=False, dependencies=[READ])

# Newest surfaces and photographs that the page lists.
_MAX_SURFACES = 40
MAX_PHOTOGRAPHS = 60
"""Older photographs are on the page of all photographs."""
# Newest decisions on the active surface that the page lists.
_MAX_DECISIONS = 5
# Points along each side of a facet in the 3D view.
_SPACE_SAMPLES = 14
# The least, and the most on all facets together, which a browser can turn.
_LEAST_SPACE, _MOST_SPACE = 4, 8000
_OF_PEAK = "of the measured peak"
# Size of the window of measured fluxes [m].
_WINDOW = (4.0, 4.0)


@dataclass(frozen=True)
class Revision:
    """A line of the surface history."""

    row: SurfaceRow
    figures: FieldTotals
    change_mm: float | None


@dataclass(frozen=True)
class ComparisonFigure:
    """A comparison and its three maps."""

    formats: ClassVar[tuple[str, ...]] = ("npz", "png")

    comparison: PhotographComparison
    measured: HeatMap
    forecast: HeatMap
    difference: HeatMap

    @property
    def title(self) -> str:
        """Title of the figure."""
        return f"Light and forecast of {self.comparison.measurement.identifier}"

    @property
    def arrays(self) -> dict[str, NDArray[Any]]:
        """The three maps, as shares of the measured peak."""
        return {name: getattr(self, name).values for name in ("measured", "forecast", "difference")}

    def drawn(self) -> bytes:
        """The three maps side by side, as PNG."""
        title = f"{self.comparison.measurement.identifier}: accuracy {self.comparison.accuracy:.1%}"
        bounds = self.measured.scale.high, self.difference.scale.high
        return comparison_picture(
            self.measured.values, self.forecast.values, self.measured.width, title, bounds
        )


def newest_surfaces(session: Session, heliostat: HeliostatRow) -> list[SurfaceRow]:
    """The newest surfaces of a heliostat with their arrays, newest first."""
    query = (
        select(SurfaceRow)
        .where(SurfaceRow.heliostat_id == heliostat.id)
        .options(undefer(SurfaceRow.arrays))
    )
    return list(session.scalars(query.order_by(SurfaceRow.version.desc()).limit(_MAX_SURFACES)))


def _rms_mm(heights: NDArray[Any]) -> float:
    return float(np.sqrt(np.mean(heights**2)) * 1e3)


def versions(rows: Sequence[SurfaceRow]) -> list[Revision]:
    """Surfaces, newest first, each with its change from the next older one [mm RMS]."""
    heights = [unpack(row.arrays)["z"] for row in rows]
    changes = [
        _rms_mm(new - old) if new.shape == old.shape else None
        for new, old in itertools.pairwise(heights)
    ]
    return [
        Revision(row, field_totals(row.arrays), change)
        for row, change in zip(rows, [*changes, None], strict=False)
    ]


def _histories(listed: Sequence[Revision]) -> list[History]:
    oldest_first = list(reversed(listed))
    deviation = [(f"version {v.row.version}", v.figures.deviation_mm) for v in oldest_first]
    changes = [
        (f"version {v.row.version}", v.change_mm) for v in oldest_first if v.change_mm is not None
    ]
    drawn = [charts.history("Deviation from ideal by version", "mm", deviation, 3)]
    return (
        [*drawn, charts.history("Change from the version before", "mm", changes, 3)]
        if changes
        else drawn
    )


def space_view(z: NDArray[Any], places: FacetPlaces, bound: float) -> str:
    """JSON for `surface3d.js`.

    It holds the place of each facet [m] and its heights on a regular grid [mm], with null beside
    its outline. The colours end at ``bound`` [mm], as on the map.
    """
    samples = max(_LEAST_SPACE, min(_SPACE_SAMPLES, math.isqrt(_MOST_SPACE // len(z))))
    heights, low = mirror_heights(z, samples), places.box[0]
    side = np.linspace(-1, 1, samples)
    u, v = np.meshgrid(side, side, indexing="ij")
    facets = []
    for facet, outline in enumerate(places.outlines):
        # A sample on the edge is inside.
        inside = inside_outline(0.999 * u, 0.999 * v, outline)
        known = [
            [round(height, 4) if kept else None for height, kept in zip(*row, strict=True)]
            for row in zip(heights[facet].tolist(), inside.tolist(), strict=True)
        ]
        vectors = np.round([places.centers[facet], *places.halves[facet]], 5).tolist()
        facets.append(dict(zip(("center", "x", "y"), vectors, strict=True)) | {"heights": known})
    size = np.round(places.box[1] - low, 5).tolist()
    middle = np.round(places.box.mean(axis=0), 5).tolist()
    colours = ColourScale("RdBu_r", 0, 1, "").names(np.linspace(0, 1, 33).tolist())
    return json.dumps(
        {"size": size, "middle": middle, "bound": bound, "facets": facets, "colours": colours}
    )


@dataclass(frozen=True)
class ComparisonFigures:
    """All comparisons and their two common scales.

    ``beyond`` is the largest difference if it exceeds the scale, else None.
    """

    figures: list[ComparisonFigure]
    flux: ColourScale
    difference: ColourScale
    beyond: float | None


def comparison_figures(
    comparisons: Sequence[PhotographComparison], bound: float
) -> ComparisonFigures:
    """Maps in shares of each photograph's measured peak, as in study reports.

    ``bound`` is the end of the scale of differences [1].
    """
    pairs = [(c.measured / c.measured.max(), c.forecast / c.measured.max()) for c in comparisons]
    top = max((float(image.max()) for pair in pairs for image in pair), default=1.0)
    largest = max(
        (float(np.abs(forecast - measured).max()) for measured, forecast in pairs), default=0.0
    )
    flux, difference = charts.flux_scale(top, _OF_PEAK), charts.difference_scale(bound, _OF_PEAK)
    figures = []
    for comparison, (measured, forecast) in zip(comparisons, pairs, strict=True):
        shown = (
            ("measured", measured, flux),
            ("forecast", forecast, flux),
            ("forecast minus measured", forecast - measured, difference),
        )
        name = comparison.measurement.identifier
        maps = [
            charts.heat_map(f"{what} flux of {name}", image, _WINDOW, scale)
            for what, image, scale in shown
        ]
        figures.append(ComparisonFigure(comparison, *maps))
    return ComparisonFigures(figures, flux, difference, largest if largest > bound else None)


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
    return choice.maps(facet_places(read.row, read.origin, n_facets), ends)


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
    row: HeliostatRow
    origin: tuple[float, float, float]
    today: SurfaceRow | None
    surface: SurfaceRow | None
    surfaces: list[SurfaceRow]
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
        surfaces = newest_surfaces(session, row)
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


@router.get("/heliostats/{name}")
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
    return render(
        request,
        "heliostat.html",
        version=read.version,
        heliostat=read.row,
        size=read.row.size_m,
        surface=read.surface,
        today=read.today,
        versions=listed,
        decided=read.decided,
        undoable=read.undoable,
        histories=_histories(listed) if listed else [],
        timelines=_timelines(read, runtime.settings),
        comparisons=comparison_figures(comparisons, ends["flux_difference"]),
        trouble=read.compared.trouble,
        groups=read.groups[:MAX_PHOTOGRAPHS],
        verdict=read.verdict,
        older=read.groups[MAX_PHOTOGRAPHS - 1].mark if len(read.groups) > MAX_PHOTOGRAPHS else None,
        rank=rank_of(comparisons),
        accuracy_seen=fmean(seen)
        if (seen := [c.accuracy for c in comparisons if c.was_used])
        else None,
        mount=read.mount,
        line=read.line,
        best=read.best,
        causes=read.causes,
        evidence=read.evidence,
        exclusions=read.exclusions,
        choice=read.choice,
        acknowledgement=read.acknowledgement,
        choice_maps=None if read.choice is None else _choice_maps(read, read.choice, ends),
        pointing=None if read.mount is None else _mount_context(read.mount),
        **(
            _surface_context(read.row, read.surface, read.origin, ends)
            if read.surface is not None
            else {}
        ),
    )
