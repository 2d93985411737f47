"""Comparison of two surfaces of one heliostat or two.

Maps share one scale. The page also shows the forecasts of both surfaces, and their history.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from operator import attrgetter
from statistics import fmean
from typing import Annotated

import numpy as np
from fastapi import APIRouter, Depends, Query, Request
from fastapi.responses import HTMLResponse
from pydantic import model_validator
from sqlalchemy.orm import Session

from model.errors import InvalidInputError, ModelError
from model.metrics import flux_accuracy
from service import store
from service.base.arrays import unpack
from service.base.errors import NotFoundError
from service.base.fields import (
    AZIMUTH,
    ELEVATION,
    FormDay,
    Model,
    Name,
    Sun,
    Version,
    drop_empty_fields,
    start_of_day,
)
from service.base.settings import Settings
from service.drawing import charts
from service.drawing.charts import HeatMap
from service.drawing.facets import FacetPlaces
from service.drawing.timelines import Timeline, Value
from service.store import mounts
from service.store.columns import EPOCH
from service.store.listing import EVER, NEWEST_FIRST, Period
from service.store.tables import HeliostatRow, MountRow, SurfaceRow
from service.twin.alarms.field_overview import SurfaceErrors, field_totals, surface_errors
from service.twin.forecasts.aims import plant_time_zone
from service.twin.forecasts.heliostat_forecast import trace_request
from service.twin.forecasts.requests import ForecastIn
from service.twin.operations import Forecast
from service.twin.runtime import Runtime
from service.twin.stored_mount import facet_places
from service.twin.surfaces.accuracy import RECENT, ComparisonResult, is_misleading
from service.twin.surfaces.present_shape import epoch_of
from service.web.auth.dependencies import (
    COMPUTE_SLOT,
    READ,
    RENDER_SLOT,
    ComparisonCacheDep,
    RuntimeDep,
)
from service.web.resources.forecasts import sun_now
from service.web.resources.heliostat_figures import (
    OverTime,
    accuracy_over_time,
    accuracy_values,
    draw_on_one_axis,
    pointing_over_time,
    pointing_values,
    version_marks,
)
from service.web.resources.heliostats import MAX_SURFACES
from service.web.responses.pages import render

pages = APIRouter(include_in_schema=False)

_RESOLUTION = (128, 128)


class CompareQuery(Model):
    """What to compare: one version each of one heliostat or two, with a sun and a target.

    Without versions, the page compares the active surface with the version before it. If the active
    surface is the first, the page compares it with the newest. For two heliostats, both surfaces
    are the active ones. ``since`` and ``until`` are days in
    the plant's zone.
    """

    heliostat: Name | None = None
    version: Version | None = None
    other: Name | None = None
    other_version: Version | None = None
    target: Name | None = None
    azimuth_deg: Annotated[float, AZIMUTH] | None = None
    elevation_deg: Annotated[float, ELEVATION] | None = None
    since: FormDay | None = None
    until: FormDay | None = None

    _filled = model_validator(mode="before")(drop_empty_fields)

    def span(self, zone: str) -> Period:
        """From the beginning of the first day to the end of the last, in the plant's ``zone``."""
        return Period(start_of_day(self.since, zone), start_of_day(self.until, zone, 1))


@dataclass(frozen=True)
class Side:
    """One of the two surfaces. ``versions`` are those of its heliostat, oldest first."""

    heliostat: HeliostatRow
    surface: SurfaceRow
    versions: Sequence[SurfaceRow]
    mounts: Sequence[MountRow]
    z: charts.Array
    places: FacetPlaces

    @property
    def name(self) -> str:
        """Label on the page."""
        return f"{self.heliostat.name}, version {self.surface.version}"

    @property
    def shape(self) -> SurfaceErrors:
        """Deviation of the surface from the ideal mirror, by kind."""
        return surface_errors(self.z, self.places.sizes)

    def shape_of(self, surface: SurfaceRow) -> SurfaceErrors:
        """The same of one of its versions, which may have other facets."""
        z = unpack(surface.arrays)["z"]
        is_same = len(z) == len(self.z)
        places = self.places if is_same else FacetPlaces.in_rows(len(z), self.heliostat.size_m)
        return surface_errors(z, places.sizes)

    @property
    def uncertainty_mm(self) -> float | None:
        """Uncertainty of the surface [mm]."""
        return field_totals(self.surface.arrays).uncertainty_mm


_MAX_MOUNTS = 40


def _side(session: Session, name: str, version: int | None) -> Side:
    """Load a surface of a heliostat: this version, or the active one."""
    heliostat = store.get_heliostat(session, name)
    versions = store.list_surfaces(
        session, heliostat, MAX_SURFACES, arrays=True, order=NEWEST_FIRST
    )
    if version is None:
        surface = store.get_surface_at(session, heliostat)
    else:
        surface = store.get_surface(session, heliostat, version)
    made = mounts.list_mounts(session, heliostat, _MAX_MOUNTS)
    z = unpack(surface.arrays)["z"].astype(np.float64)
    places = facet_places(heliostat, store.get_plant(session).origin, len(z))
    return Side(heliostat, surface, versions[::-1], made, z, places)


def _require_as_many_facets(first: Side, second: Side) -> None:
    """Raise InvalidInputError if the numbers of facets differ."""
    if len(first.z) != len(second.z):
        raise InvalidInputError(
            f"other: {first.name} has {len(first.z)} facets, and {second.name} has"
            f" {len(second.z)}; choose mirrors with as many facets"
        )


def _sides(session: Session, query: CompareQuery) -> tuple[Side, Side]:
    """The two surfaces. Without versions, the newer one is second."""
    assert query.heliostat is not None
    second = _side(session, query.other or query.heliostat, query.other_version)
    if query.version is not None or second.heliostat.name != query.heliostat:
        return _side(session, query.heliostat, query.version), second
    of, version = second.heliostat, second.surface.version
    for before in store.list_surfaces(session, of, 1, version, order=NEWEST_FIRST):
        return _side(session, query.heliostat, before.version), second
    for newest in store.list_surfaces(session, of, 1, order=NEWEST_FIRST):
        if newest.version > version:
            return second, _side(session, query.heliostat, newest.version)
    raise NotFoundError(f"heliostat {query.heliostat} has one surface only")


# --- maps
# --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Trio:
    """Two maps on one scale, and the second minus the first."""

    first: HeatMap
    second: HeatMap
    difference: HeatMap


def _surfaces(first: Side, second: Side, ends: Mapping[str, float]) -> Trio:
    one, other = (
        charts.surface_map(f"Deviation of {side.name}", side.z, side.places, ends["heights"])
        for side in (first, second)
    )
    title = f"{second.name} minus {first.name}"
    return Trio(
        one,
        other,
        charts.surface_map(title, second.z - first.z, second.places, ends["height_change"]),
    )


@dataclass(frozen=True)
class Forecasts:
    """Flux of two surfaces on one target, and the agreement of both [1]."""

    maps: Trio
    first: Forecast
    second: Forecast
    agreement: float


def _forecasts(runtime: Runtime, sides: tuple[Side, Side], target: str, sun: Sun) -> Forecasts:
    """Trace both surfaces; ModelError if the light does not reach the target."""
    traced = [
        trace_request(
            runtime,
            ForecastIn(
                heliostat=side.heliostat.name,
                sun=sun,
                target=target,
                surface=side.surface.version,
                resolution=_RESOLUTION,
            ),
        )
        for side in sides
    ]
    one, other = (made.forecast for made in traced)
    size = traced[0].receiver.width, traced[0].receiver.height
    top = max(float(one.flux.max()), float(other.flux.max()))
    first, second = (
        charts.irradiance_map(f"Flux of {side.name} on {target}", made.flux, size, top)
        for side, made in zip(sides, (one, other), strict=True)
    )
    bound = max(runtime.settings.figure_scales["flux_difference"] * top, 1e-9)
    difference = charts.difference_map(
        "Second minus first", (other.flux - one.flux) / 1e3, size, "kW/m²", bound / 1e3
    )
    return Forecasts(
        Trio(first, second, difference), one, other, flux_accuracy(one.flux, other.flux)
    )


# --- over time
# --------------------------------------------------------------------------------------------------


def _within(values: Sequence[Value], span: Period) -> list[Value]:
    """Values of a period; those without a time are of no period."""
    return [one for one in values if span.contains(one.at)]


def _timelines(
    data: "_ComparisonData", sides: tuple[Side, Side], span: Period, settings: Settings
) -> list[Timeline]:
    """Timelines of accuracy, shape and pointing on one time axis.

    Each marks the versions of the surfaces.
    """
    heliostats = {side.heliostat.name: side for side in sides}
    marks = [
        mark
        for name, side in heliostats.items()
        for mark in version_marks(side.versions, f"{name} " if len(heliostats) > 1 else "v")
    ]
    accuracy = {
        side.name: accuracy_values(() if one is None else one.comparisons)
        for side, one in zip(sides, data.compared, strict=True)
    }
    shapes = {
        name: [(row, side.shape_of(row)) for row in side.versions]
        for name, side in heliostats.items()
    }

    def of_shape(figure: str) -> dict[str, list[Value]]:
        return {
            name: [
                Value(row.valid_from, getattr(shape, figure), f"version {row.version}")
                for row, shape in rows
            ]
            for name, rows in shapes.items()
        }

    pointing = {
        name: pointing_values(side.mounts[-1] if side.mounts else None)
        for name, side in heliostats.items()
    }
    charts = [
        accuracy_over_time(accuracy, settings),
        OverTime("Deviation from the ideal mirror", "mm", of_shape("deviation_mm"), 3),
        OverTime("Canting of the facets", "mrad", of_shape("canting_mrad"), 3),
        pointing_over_time(pointing, settings),
    ]
    within = [
        replace(one, series={name: _within(some, span) for name, some in one.series.items()})
        for one in charts
    ]
    return draw_on_one_axis(within, data.zone, marks)


def _unseen(
    compared: Sequence[ComparisonResult], epochs: Sequence[Period]
) -> tuple[list[float], int]:
    """Mean accuracies [1] on photographs that neither surface was made from, and their number.

    They are the `RECENT` newest of some epochs, as when a new surface is judged.
    """
    found = [
        {c.measurement.id: c for c in one.comparisons if epoch.contains(c.measurement.taken_at)}
        for one, epoch in zip(compared, epochs, strict=True)
    ]
    rows = {number: c.measurement for one in found for number, c in one.items()}
    either = found[0].keys() & found[1].keys() or found[0].keys() | found[1].keys()
    fair = {
        number
        for number in either
        if not any(one[number].was_used for one in found if number in one)
    }
    clear = {number for number in fair if not is_misleading(rows[number])} or fair
    order = sorted(clear, key=lambda number: (rows[number].taken_at or EPOCH, number))
    newest = order[::-1][:RECENT]
    means = [[one[number].accuracy for number in newest if number in one] for one in found]
    return [fmean(some) for some in means if some], len(newest)


# --- the page
# --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _ComparisonData:
    """Data of the page, read before the slot for drawing is taken.

    The slot must not be held while the comparisons are computed.
    """

    sides: tuple[Side, Side] | None
    epochs: Sequence[Period]
    alone: str | None
    compared: Sequence[ComparisonResult | None]
    targets: Sequence[str]
    sun: Sun
    zone: str


def _read(
    query: Annotated[CompareQuery, Query()], runtime: RuntimeDep, cache: ComparisonCacheDep
) -> _ComparisonData:
    with runtime.database.reading() as session:
        targets = [row.name for row in store.list_targets(session)]
        sun = sun_now(store.find_plant(session))
        zone = plant_time_zone(session, runtime.settings.time_zone)
        sides, alone = None, None
        if query.heliostat is not None:
            store.get_heliostat(session, query.heliostat)
            try:
                sides = _sides(session, query)
            except NotFoundError as error:
                if (query.version, query.other, query.other_version) != (None, None, None):
                    raise
                alone = str(error)
        if sides is not None:
            _require_as_many_facets(*sides)
        span = query.span(zone)
        epochs = [span] * len(sides or ())
        if sides is not None and span == EVER:
            by_version = sorted((side.surface for side in sides), key=attrgetter("version"))
            newest = {surface.heliostat_id: surface for surface in by_version}
            rows = [side.heliostat for side in sides]
            epochs = [epoch_of(session, row, newest[row.id]) for row in rows]
        shown = [cache.read(session, side.heliostat, side.surface, span) for side in sides or ()]
    compared = [ComparisonResult() if one is None else cache.wait_for(one) for one in shown]
    given = {"azimuth_deg": query.azimuth_deg, "elevation_deg": query.elevation_deg}
    sun = sun.model_copy(update={name: angle for name, angle in given.items() if angle is not None})
    return _ComparisonData(sides, epochs, alone, compared, targets, sun, zone)


@pages.get("/compare", dependencies=[READ, RENDER_SLOT, COMPUTE_SLOT])
def get_compare_page(
    query: Annotated[CompareQuery, Query()],
    read: Annotated[_ComparisonData, Depends(_read)],
    request: Request,
    runtime: RuntimeDep,
) -> HTMLResponse:
    """The comparison of two surfaces, or the form that asks for them."""
    target = query.target or next(iter(read.targets), None)
    filled = {"query": query, "sun": read.sun, "target": target, "targets": read.targets}
    page = partial(render, request, "compare.html", **filled)
    if read.sides is None:
        return page(sides=None, alone=read.alone)
    known = [one for one in read.compared if one is not None]
    forecasts, trouble = None, next((one.trouble for one in known if one.trouble), None)
    try:
        forecasts = None if target is None else _forecasts(runtime, read.sides, target, read.sun)
    except ModelError as error:
        trouble = str(error)
    is_whole = len(known) == len(read.compared)
    return page(
        sides=read.sides,
        alone=None,
        surfaces=_surfaces(*read.sides, runtime.settings.figure_scales),
        change_mm=1e3 * float(np.sqrt(np.mean((read.sides[1].z - read.sides[0].z) ** 2))),
        forecasts=forecasts,
        trouble=trouble,
        unseen=_unseen(known, read.epochs) if is_whole else None,
        timelines=_timelines(read, read.sides, query.span(read.zone), runtime.settings),
        again=None if is_whole else str(request.url.query),
    )
