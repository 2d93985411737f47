"""The job `aim-plans`: aim points of the most power under the flux that a receiver can take."""

import math
import pickle
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, date, datetime, timedelta
from datetime import time as clock
from hashlib import sha256
from typing import Annotated, Any, Self
from zoneinfo import ZoneInfo

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Discriminator, Field, Tag, field_validator, model_validator
from sqlalchemy import select
from sqlalchemy.orm import Session

from model.aiming.kernels import LARGE_PAIRS, Kernels, require_few_pairs
from model.aiming.plan import AimPlan, plan_aims
from model.ephemeris import sun_positions
from model.errors import InvalidInputError
from model.frames import sun_direction
from model.plant import Receiver, square_pixels
from model.times import format_minute, format_time
from service import store
from service.base.arrays import unpack
from service.base.errors import ConflictError
from service.base.fields import (
    AnySun,
    Model,
    Name,
    Number,
    Position,
    Resolution,
    Sun,
    SunAt,
    parse_moment,
)
from service.base.processes import return_memory
from service.jobs.kind import MAX_PIXELS, Context, Kind, Result, require_some
from service.jobs.kinds.field_forecasts import FleetForecastIn, expected_s
from service.sources.limits import Limit
from service.store import queue
from service.store.tables import HeliostatRow
from service.twin.forecasts.aims import (
    ROWS,
    SOURCES,
    AimDrives,
    aim_figures,
    begin_at,
    excess_of,
    no_drive,
    places_on,
    plant_time_zone,
    sources_of,
)
from service.twin.forecasts.field_forecast import (
    Fleet,
    HeliostatGroup,
    TracedImages,
    forecast_group,
    group_warnings,
    trace_kernels,
)
from service.twin.forecasts.heliostat_forecast import receiver_as_json
from service.twin.forecasts.requests import position_of
from service.twin.runtime import Runtime

MAX_STEPS = 100
"""Maximum number of steps of a day."""

MAX_AIMS = 200_000
"""Maximum number of aims of a plan over all its steps. As JSON they are some 30 MB."""

FluxLimit = Annotated[Number, Field(gt=0, le=6e7)]

LimitRow = Annotated[list[FluxLimit], Field(min_length=1, max_length=1024)]


def _way_to_give(value: Any) -> str:
    return "(map)" if isinstance(value, list) else "(number)"


LimitOfMap = Annotated[
    Annotated[FluxLimit, Tag("(number)")] | Annotated[list[LimitRow], Tag("(map)")],
    Discriminator(_way_to_give),
]


Minute = Annotated[clock, Field(description="Time of day at the plant, such as 09:30.")]


_Date = date


class DayIn(Model):
    """The steps of a day by the clocks of the plant."""

    date: _Date = Field(description="Of the plant's calendar.")
    first: Minute = clock(0, 0)
    last: Minute = clock(23, 59)
    step_minutes: Number = Field(
        default=60.0, ge=1, le=1440, description="From one step to the next [min]."
    )

    @field_validator("date")
    @classmethod
    def _is_near(cls, day: _Date) -> _Date:
        parse_moment(datetime.combine(day, clock(), UTC))
        return day

    @field_validator("first", "last")
    @classmethod
    def _has_no_zone(cls, at: clock) -> clock:
        if at.tzinfo is not None:
            raise ValueError("give the time at the plant, without a zone")
        return at

    @model_validator(mode="after")
    def _some_steps(self) -> Self:
        if self.last < self.first:
            raise ValueError("last: give a time after first")
        if self.count() > MAX_STEPS:
            raise ValueError(_too_many_steps(self.count()))
        return self

    def count(self) -> int:
        """Number of steps, also of those with the sun below the horizon.

        On a day of a clock change `times` has an hour's steps more or fewer.
        """
        length = datetime.combine(self.date, self.last) - datetime.combine(self.date, self.first)
        return length // timedelta(minutes=self.step_minutes) + 1

    def times(self, zone: str) -> list[datetime]:
        """The times of the steps in UTC, for the plant's time zone.

        A time that the clocks of a day show twice begins with the first, and ends with the second.
        """
        first, *_ = _in_utc(self.date, self.first, zone)
        last, step = max(_in_utc(self.date, self.last, zone)), timedelta(minutes=self.step_minutes)
        return [first + number * step for number in range((last - first) // step + 1)]


def _in_utc(day: date, at: clock, zone: str) -> list[datetime]:
    """What a time of day in a zone can be: it differs only if clocks show it twice, or never."""
    local = datetime.combine(day, at, ZoneInfo(zone))
    return [local.replace(fold=fold).astimezone(UTC) for fold in (0, 1)]


def _too_many_steps(count: int) -> str:
    return f"step_minutes: {count} steps are too many; a day has at most {MAX_STEPS}"


class AimPlanIn(FleetForecastIn):
    """Find the aim points of the most power on a receiver under the flux that it can take.

    In 95 % of cases of the pointing errors the whole map is within the limit. Heliostats are left
    inactive only where no aims keep it. The aims are those for one sun, or for the steps of a day.
    """

    sun: AnySun | None = Field(  # type: ignore[assignment]
        default=None,
        description='One sun: its position, or the time, `{"at": ..}`; either this or `day`.',
    )
    day: DayIn | None = Field(
        default=None,
        description=(
            "Steps of a day in the plant's time; either this or `sun`. The aims of each step begin"
            " with those of the step before. Steps with the sun below the horizon are left out."
        ),
    )
    limit_w_m2: LimitOfMap = Field(
        description=(
            "Flux that the receiver can take [W/m2]: one number, or rows of numbers over the"
            " unrolled map, from its upper left."
        )
    )
    aim_points_m: dict[Name, Position] = Field(
        default_factory=dict,
        max_length=20_000,
        description="Aims to begin with [m], such as those of a plan a moment before, by name.",
    )
    resolution: Resolution | None = Field(  # type: ignore[assignment]
        default=None,
        description="Rows and columns of the map; 32 rows of square pixels if not given.",
    )

    @field_validator("limit_w_m2")
    @classmethod
    def _is_a_map(cls, limit: float | list[list[float]]) -> float | list[list[float]]:
        if isinstance(limit, list) and len({len(row) for row in limit}) != 1:
            raise ValueError("must have rows of the same length")
        return limit

    @model_validator(mode="after")
    def _sun_or_day(self) -> Self:
        if (self.sun is None) == (self.day is None):
            raise ValueError("give either sun or day")
        if self.day is not None and self.resolution is not None:
            count, (rows, columns) = self.day.count(), self.resolution
            if count * rows * columns > MAX_PIXELS:
                raise ValueError(
                    f"day.step_minutes, resolution: {count} steps of {rows} x {columns} pixels are"
                    f" too many; a plan has at most {MAX_PIXELS} pixels in all of them together"
                )
        return self

    def map_on(self, receiver: Receiver) -> Resolution:
        """Rows and columns of the map."""
        return self.resolution or square_pixels(receiver, ROWS)

    def limit(self) -> Limit:
        """The limit over the map."""
        rows = self.limit_w_m2 if isinstance(self.limit_w_m2, list) else [[self.limit_w_m2]]
        return Limit(np.array(rows, dtype=np.float64))


# --- times
# --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Suns:
    """Times (None for a sun without one) and suns of a plan's steps, and what is left out."""

    steps: list[tuple[datetime | None, Sun]]
    below_horizon: list[datetime]
    zone: str
    day: date | None


def _suns(session: Session, payload: AimPlanIn, zone: str) -> _Suns:
    if payload.day is None:
        assert payload.sun is not None  # the schema requires one of the two
        at = payload.sun.at if isinstance(payload.sun, SunAt) else None
        day = None if at is None else at.astimezone(ZoneInfo(zone)).date()
        return _Suns([(at, position_of(session, payload.sun))], [], zone, day)
    times = payload.day.times(zone)
    angles = sun_positions(times, store.get_plant(session).origin).tolist()
    steps: list[tuple[datetime | None, Sun]] = []
    below = []
    for at, (azimuth, up) in zip(times, angles, strict=True):
        if up > 0:
            steps.append((at, Sun(azimuth_deg=azimuth, elevation_deg=up)))
        else:
            below.append(at)
    require_some(len(steps), {"the sun": "it is below the horizon at all steps of the day"})
    return _Suns(steps, below, zone, payload.day.date)


# --- the plan
# --------------------------------------------------------------------------------------------------

# Step with the aims, which may be many.
_AIMS = "aims"


def step_name(index: int) -> str:
    """Name of the job step with the maps and aims of a plan's step."""
    return f"{index:03d}"


def plan_field(context: Context, payload: AimPlanIn) -> Result:
    """Trace an image of each heliostat, and move the aims, step by step.

    A restarted job continues with the step that it was at.
    """
    runtime = context.runtime
    with runtime.database.reading() as session:
        suns = _suns(session, payload, plant_time_zone(session, runtime.settings.time_zone))
    fleet = payload.fleet(runtime)
    require_few_pairs(len(fleet.names), payload.map_on(fleet.receiver))
    names = _require_few_aims(fleet, suns)
    with runtime.database.reading() as session:
        drives = AimDrives.read(session, names, fleet.model)
        sources = sources_of(session, names, payload.model_version)
    if fleet.states is not None:
        sources["states"] = {name: fleet.states.values_of(name) for name in names}
    done = context.steps()
    if SOURCES not in done:
        with runtime.database.writing() as session:
            context.keep(session, SOURCES, sources)
    planner = _Planner(context, payload, fleet, _nearest_first(runtime, fleet), drives, suns)
    for index in range(len(suns.steps)):
        if step_name(index) not in done:
            with planner.memory():
                planner.plan(index)
    return _result(context, payload, planner)


def _require_few_aims(fleet: Fleet, suns: _Suns) -> list[str]:
    """Names of the plan's heliostats; ConflictError if there are too many with its steps."""
    names = list(fleet.names)
    if len(names) * len(suns.steps) > MAX_AIMS:
        raise ConflictError(
            f"{len(suns.steps)} steps of {len(names)} heliostats are too many; a plan has at most"
            f" {MAX_AIMS} aims; give a larger day.step_minutes, or a part of the day"
        )
    return names


@dataclass(frozen=True, eq=False)
class StepAims:
    """Aims of a step, as they are kept with its maps.

    Attributes
    ----------
    names : (N,) str
    points : (N, 3) [m]
    active : (N,) bool
    multipliers : (P,)
        See `AimPlan`.
    """

    names: NDArray[np.str_]
    points: NDArray[np.float64]
    active: NDArray[np.bool_]
    multipliers: NDArray[np.float32]

    @classmethod
    def of(cls, arrays: Mapping[str, NDArray[Any]]) -> "StepAims":
        """The aims of a step's kept arrays."""
        kept = (arrays[name] for name in ("names", "points", "active", "multipliers"))
        return cls(*kept)

    def aims(self) -> dict[str, list[float]]:
        """Aim points [m] of all heliostats, by name."""
        return dict(zip(self.names.tolist(), self.points.round(4).tolist(), strict=True))

    def inactive(self) -> list[str]:
        """Names of the heliostats that are not active."""
        return sorted(self.names[~self.active].tolist())


@dataclass(frozen=True, eq=False)
class _Planner:
    """Plan the steps of a job, each from the step before.

    ``nearest_first`` is the ``fleet`` as of `_nearest_first`.
    """

    context: Context
    asked: AimPlanIn
    fleet: Fleet
    nearest_first: Fleet
    drives: AimDrives
    suns: _Suns

    @contextmanager
    def memory(self) -> Iterator[None]:
        """Hold the memory of the images: one plan of many pixels has it at a time."""
        runtime, (rows, columns) = self.context.runtime, self.asked.map_on(self.fleet.receiver)
        if len(self.fleet.names) * rows * columns <= LARGE_PAIRS:
            yield
            return
        with runtime.large_plan_slots.slot(check=self.context.check):
            yield

    def plan(self, index: int) -> None:
        """Plan a step and store it."""
        context, receiver = self.context, self.fleet.receiver
        at, sun = self.suns.steps[index]
        resolution = self.asked.map_on(receiver)
        begun = time.perf_counter()
        group = self.nearest_first.under(sun, self.asked.surface == "ideal")
        images = self._images(index, group, resolution)
        kernels, single = images.kernels, images.single_aim
        traced = time.perf_counter()
        limits = self.asked.limit().on_map(*resolution)
        limit = torch.tensor(limits, dtype=torch.float32).flatten()
        self._report(index, 0.7, "aims")
        plan = plan_aims(kernels, limit, self._begin(index, kernels, limit), context.check)
        aimed = time.perf_counter()
        self._report(index, 0.9, "what the plan is worth")
        dni = group.model.optics.dni
        power = sum(one.area * one.intercepted for one in single.losses.values()) * dni
        maps = {
            "flux": plan.flux.numpy().reshape(resolution),
            "limit": limit.numpy().reshape(resolution),
            "single_aim_flux": single.irradiance.astype(np.float32),
        }
        figures: dict[str, object] = {
            "at": None if at is None else format_time(at),
            **aim_figures(plan, plan.draws(), receiver, power),
            "exceeded": excess_of(maps["flux"], maps["limit"], receiver),
            "single_aim_exceeded": excess_of(maps["single_aim_flux"], maps["limit"], receiver),
            "sun": sun.model_dump(),
            "dni_w_m2": dni,
            "heliostats": len(kernels),
            "sources": images.sources,
            "seconds": {
                "images": round(traced - begun, 3),
                "aims": round(aimed - traced, 3),
                "all": round(time.perf_counter() - begun, 3),
            },
        }
        ideal = sorted(images.without_surface - set(images.skipped))
        about = {"figures": figures, "skipped": dict(images.skipped), "ideal_surfaces": ideal}
        with context.runtime.database.writing() as session:
            context.keep(session, step_name(index), about, maps | _aim_arrays(plan, receiver))

    def _images(
        self, index: int, group: HeliostatGroup, resolution: tuple[int, int]
    ) -> TracedImages:
        """The images for a step, or those of a recent plan from the same sources."""
        runtime, neighbours = self.context.runtime, self.asked.neighbours

        def report(share: float, message: str, **_counts: Any) -> None:
            self._report(index, share, message)

        def trace() -> TracedImages:
            middle = replace(self.fleet, aims={}).under(self.suns.steps[index][1], group.ideal)
            single = forecast_group(
                runtime, middle, resolution, neighbours, lambda *_, **__: self.context.check()
            )
            return_memory()  # before the images, which need most of it
            kernels = trace_kernels(runtime, group, resolution, neighbours, report)
            require_some(single.heliostats, single.skipped)
            without, sources = frozenset(group.without_surface), group.sources(group.skipped)
            return TracedImages(kernels, single, group.skipped, without, sources)

        with runtime.database.reading() as session:
            sources = sources_of(session, [*group.names, *group.around], group.model.number)
        of = pickle.dumps((group, resolution, neighbours, sources))
        return runtime.recent_images.get(sha256(of).digest(), trace)

    def _begin(self, index: int, kernels: Kernels, limit: torch.Tensor) -> AimPlan | None:
        """The aims that a step begins with: those that were given, or of the step before.

        A plan never activates a heliostat. So after a step that left some inactive, it begins
        again.
        """
        if index == 0:
            start = self.asked.aim_points_m
            return begin_at(kernels, limit, start) if start else None
        before = StepAims.of(self._kept(index - 1))
        if not before.active.all():
            return None
        begin = begin_at(kernels, limit, {name: np.array(p) for name, p in before.aims().items()})
        return replace(begin, multipliers=torch.tensor(before.multipliers))

    def _kept(self, index: int) -> dict[str, NDArray[Any]]:
        kept = self.context.kept_arrays(step_name(index))
        assert kept is not None  # stored in the transaction of its step
        return kept

    def _report(self, index: int, share: float, message: str) -> None:
        total, (at, _) = len(self.suns.steps), self.suns.steps[index]
        when = "" if at is None else f"{format_minute(at)}, "
        self.context.report(
            (index + share) / total,
            f"{when}{message}",
            phase="steps of the plan",
            n_done=index,
            n_total=total,
        )

    def aims_of(self, index: int) -> dict[str, object]:
        """Aims and drives of a step, as in the result."""
        at, sun = self.suns.steps[index]
        step = StepAims.of(self._kept(index))
        direction = sun_direction(sun.azimuth_deg, sun.elevation_deg)
        active = dict(zip(step.names.tolist(), step.active.tolist(), strict=True))
        aims = step.aims()
        drives = {
            name: (
                self.drives.of(name, direction, np.array(aim), at)
                if active[name]
                else no_drive("the plan leaves it inactive")
            )
            for name, aim in aims.items()
        }
        return {"aim_points_m": aims, "drives": drives}

    def largest(self) -> dict[str, NDArray[Any]]:
        """The maps of the only step, or the most of all steps at each pixel."""
        most = self._kept(0)
        maps = {name: most[name] for name in ("flux", "limit", "single_aim_flux")}
        for index in range(1, len(self.suns.steps)):
            kept = self._kept(index)
            maps = {name: np.maximum(one, kept[name]) for name, one in maps.items()}
        return maps


def _aim_arrays(plan: AimPlan, receiver: Receiver) -> dict[str, NDArray[Any]]:
    """The arrays of `StepAims`, and the aims' places on the map (N, 2) [m]."""
    return {
        "names": np.array(plan.kernels.names),
        "points": plan.points,
        "active": plan.is_active.numpy(),
        "multipliers": plan.multipliers.numpy(),
        "places": places_on(receiver, np.asarray(plan.points)),
    }


def _result(context: Context, asked: AimPlanIn, planner: _Planner) -> Result:
    """The result of all steps; the aims are kept apart from its figures."""
    kept, suns, receiver = context.steps(), planner.suns, planner.fleet.receiver
    steps = [kept[step_name(index)] for index in range(len(suns.steps))]
    figures = [step["figures"] for step in steps]
    skipped: dict[str, str] = {}
    for step in steps:
        skipped |= step["skipped"]
    ideal = sorted({name for step in steps for name in step["ideal_surfaces"]})
    heliostats = max(one["heliostats"] for one in figures)
    result: dict[str, object] = {
        "warnings": group_warnings(len(ideal), heliostats),
        "model_version": planner.fleet.model.number,
        "date": None if suns.day is None else suns.day.isoformat(),
        "heliostats": heliostats,
        "skipped": skipped,
        "ideal_surfaces": ideal,
        "plane": receiver_as_json(receiver),
    }
    aims = [planner.aims_of(index) for index in range(len(steps))]
    if asked.day is None:
        result, details = figures[0] | result, aims[0]
    else:
        result |= {
            "time_zone": suns.zone,
            "times": len(steps),
            "left_out": len(suns.below_horizon),
            "below_horizon": [format_time(at) for at in suns.below_horizon],
            "peak_w_m2": max(one["peak_w_m2"] for one in figures),
            "peak_p95_w_m2": max(one["peak_p95_w_m2"] for one in figures),
            "limit_w_m2": figures[0]["limit_w_m2"],
            "steps": figures,
        }
        details = {"steps": [one | own for one, own in zip(figures, aims, strict=True)]}
    with context.runtime.database.writing() as session:
        context.replace(session, _AIMS, details)
    return Result(result, planner.largest())


def _nearest_first(runtime: Runtime, fleet: Fleet) -> Fleet:
    """The fleet from near to far, each heliostat with its default aim.

    Images of heliostats that are traced together have one size.
    """
    row = HeliostatRow
    with runtime.database.reading() as session:
        found = session.execute(select(row.name, row.east_m, row.north_m, row.up_m)).all()
    places = {name: np.array([east, north, up]) for name, east, north, up in found}
    known = [name for name in fleet.names if name in places]
    known.sort(key=lambda name: math.dist(places[name], fleet.receiver.center))
    unknown = [name for name in fleet.names if name not in places]
    return replace(fleet, names=[*known, *unknown], aims={})


@dataclass(frozen=True, eq=False)
class PlannedAims:
    """The aims of a finished plan by its steps; times are None of a sun without one."""

    times: Sequence[datetime | None]
    steps: Sequence[StepAims]

    @classmethod
    def read(cls, session: Session, job: int) -> Self:
        """Read the aims of a plan's job; ConflictError if it has none."""
        result = queue.get_job(session, job).result
        figures = [] if result is None else result.get("steps", [result])
        packed = [queue.checkpoint_arrays(session, job, step_name(i)) for i in range(len(figures))]
        kept = [StepAims.of(unpack(data)) for data in packed if data is not None]
        if not kept or len(kept) < len(figures):
            raise ConflictError(f"aim_plan: the aims of job {job} are not stored; plan them again")
        times = [
            None if one["at"] is None else datetime.fromisoformat(one["at"]) for one in figures
        ]
        return cls(times, kept)

    def nearest(self, at: datetime) -> int:
        """Number of the step nearest to a time."""
        return min(
            range(len(self.steps)), key=lambda i: abs((self.times[i] or at) - at).total_seconds()
        )

    def aimed(self, fleet: HeliostatGroup, at: datetime) -> HeliostatGroup:
        """The group with the aims for a time; inactive mirrors send no light but block it."""
        step = self.steps[self.nearest(at)]
        aims, inactive = step.aims(), set(step.inactive())
        names = [name for name in fleet.names if name not in inactive]
        idle = {name: np.array(aims[name]) for name in fleet.names if name in inactive}
        return replace(
            fleet, names=names, aims=aims | dict(fleet.aims), around={**fleet.around, **idle}
        )


def expected_plan_s(payload: AimPlanIn, runtime: Runtime) -> float:
    """Estimated duration [s]: images, aims, and what they are compared with."""
    count = 1 if payload.day is None else payload.day.count()
    request = payload.model_copy(update={"resolution": payload.resolution or (ROWS, 2 * ROWS)})
    return 4 * count * expected_s(request, runtime)


def require_bounds(payload: AimPlanIn, runtime: Runtime) -> None:
    """Refuse too many pixels for the heliostats, and too many steps.

    Raises
    ------
    InvalidInputError
        With the field.
    """
    if payload.day is not None:
        with runtime.database.reading() as session:
            zone = plant_time_zone(session, runtime.settings.time_zone)
        if (count := len(payload.day.times(zone))) > MAX_STEPS:
            raise InvalidInputError(f"day.{_too_many_steps(count)}")
    fleet = payload.fleet(runtime)
    require_few_pairs(len(fleet.names), payload.map_on(fleet.receiver))


KIND = Kind(
    "aim-plans",
    AimPlanIn,
    plan_field,
    "Find the aim points of the most power under a limit of flux.",
    details=_AIMS,
    require=require_bounds,
    expected_s=expected_plan_s,
)
