"""Read ``plant.yaml``, the file that describes any solar tower plant."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

import numpy as np
from numpy.typing import NDArray

from model.atmosphere import attenuation_of_visibility
from model.errors import InvalidInputError
from model.heliostat_type import HeliostatType
from model.plant import Heliostat, Plant, TargetPlane, Tower
from model.site import Site
from model.sunshape import Buie, Gaussian, Pillbox, SunShape
from model.sunshape.buie import chi_of_csr
from model.tracing import Optics
from service.sources.plant_errors import Mistakes, PlantText, mistakes_at, named_file, parse_plant
from service.sources.plant_parts import AnyReceiver, read_receivers, read_targets, read_type
from service.sources.plant_schema import (
    BuieSun,
    FacetFileEntry,
    GaussianSun,
    HeliostatEntry,
    PlantDocument,
    assumed,
    nearest,
)
from service.sources.plant_tables import PlacedHeliostat, read_layout
from service.sources.text_lines import YamlDocument, read_yaml

Array = NDArray[np.float64]

# Least distance between a heliostat's pivot and what it aims at [m].
_NEAREST = 1.0


@dataclass(frozen=True, eq=False)
class PlantDescription:
    """A plant as its file describes it.

    Attributes
    ----------
    plant : Plant
        With its heliostats and targets, and the planes and cylinders of its receivers.
    types : dict
        Heliostat types by name.
    receivers : dict
        All receivers by name.
    type_of : dict
        Names of types by heliostat.
    layout : dict
        What the layout says of each heliostat, with the receiver that it is made for.
    receiver_of : dict
        What each heliostat is canted and focused to: a receiver, or a target.
    optics : Optics
        Sun shape and attenuation; reflectance and errors are the heliostats'.
    tower : Tower or None
    time_zone : str
        Name in the IANA time zone database.
    altitude : float [m]
    marks_of : dict
        Marks by target: ``none`` or ``l_brackets``.
    files : tuple of str
        Files that it names, relative to its folder.
    assumed : tuple of str
        What the file leaves to its defaults, as lines ``key.path: value``.
    warnings : tuple of str
    """

    plant: Plant
    types: dict[str, HeliostatType]
    receivers: dict[str, AnyReceiver]
    type_of: dict[str, str]
    layout: dict[str, HeliostatEntry]
    receiver_of: dict[str, str]
    optics: Optics
    tower: Tower | None
    time_zone: str
    altitude: float
    marks_of: dict[str, str]
    files: Sequence[str] = ()
    assumed: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()


def read_plant(path: Path) -> PlantDescription:
    """Read a plant from its file, and the files that it names.

    Raises
    ------
    InvalidInputError
        It names file, line and key path of each mistake, and what to do.
    """
    document = read_yaml(path)
    try:
        entries = parse_plant(document)
    except InvalidInputError as error:
        _require_layout_too(path.parent, document, str(error))
        raise
    return _PlantReader(PlantText(path.parent, document, entries)).plant()


def _require_layout_too(folder: Path, document: YamlDocument, found: str) -> None:
    """Raise the mistakes ``found`` in a document with those of the layout that it names, if any."""
    layout = document.value.get("layout") if isinstance(document.value, dict) else None
    name = layout.get("file") if isinstance(layout, dict) else None
    if isinstance(name, str):
        mistakes = Mistakes()
        mistakes.found.append(found)
        with mistakes.collected():
            _require_different(read_layout(named_file(folder, document, name), mistakes), mistakes)
        mistakes.require_none()


class _PlantReader:
    """Builds the parts of a plant from its document."""

    def __init__(self, text: PlantText) -> None:
        self.text = text
        self.entries = text.entries

    def plant(self) -> PlantDescription:
        """The whole plant."""
        header = self.entries.plant
        mistakes = Mistakes()
        types: dict[str, HeliostatType] = {}
        receivers: dict[str, AnyReceiver] = {}
        targets: dict[str, TargetPlane] = {}
        layout: list[PlacedHeliostat] = []
        with mistakes.collected():
            receivers = read_receivers(self.text)
        with mistakes.collected():
            targets = read_targets(self.text)
        for name in self.entries.heliostat_types:
            with mistakes.collected():
                types[name] = read_type(self.text, name)
        with mistakes.collected():
            layout = self._layout(mistakes)
        for check in (self._time_zone, self._sun, self._attenuation):
            with mistakes.collected():
                check()
        _check_names(layout, self.entries, mistakes)
        mistakes.require_none()
        goals: dict[str, AnyReceiver] = {**receivers, **targets}
        receiver_of = self._receiver_of(layout, goals)
        heliostats = self._heliostats(layout, types, goals, receiver_of)
        site = Site(**header.model_dump(include={field.name for field in fields(Site)}))
        return PlantDescription(
            plant=Plant(header.name, np.array(site.origin), targets, heliostats, receivers),
            types=types,
            receivers=receivers,
            type_of={placed.entry.name: placed.entry.type for placed in layout},
            layout={
                name: placed.entry.model_copy(update={"receiver": receiver_of[name]})
                for placed in layout
                for name in [placed.entry.name]
            },
            receiver_of=receiver_of,
            optics=Optics(sun_shape=self._sun(), attenuation=self._attenuation()),
            tower=self._tower(),
            time_zone=self._time_zone(),
            altitude=header.altitude_m,
            marks_of={name: target.marks for name, target in self.entries.targets.items()},
            files=_files(self.entries),
            assumed=tuple(assumed(self.entries)),
            warnings=tuple(_warnings(self.text, layout)),
        )

    def _place(self, *path: str | int) -> str:
        return self.text.place(*path)

    # --- site, sun, air

    def _time_zone(self) -> str:
        name = self.entries.plant.time_zone
        try:
            ZoneInfo(name)
        except (ZoneInfoNotFoundError, ValueError, OSError):
            raise InvalidInputError(
                f"{self._place('plant', 'time_zone')}: {name[:60]!r} is no name of the IANA time"
                " zone database; write one such as America/Los_Angeles"
            ) from None
        return name

    def _sun(self) -> SunShape:
        sun = self.entries.sun
        if isinstance(sun, BuieSun):
            if sun.csr is not None:
                with mistakes_at(self._place("sun", "csr")):
                    return Buie(chi_of_csr(sun.csr))
            return Buie(float(sun.chi or 0))
        if isinstance(sun, GaussianSun):
            return Gaussian(sun.sigma_mrad / 1e3)
        return Pillbox(sun.half_angle_mrad / 1e3)

    def _attenuation(self) -> tuple[float, ...]:
        air = self.entries.atmosphere
        if air is None:
            return ()
        if air.visibility_km is None:
            return tuple(air.attenuation or ())
        with mistakes_at(self._place("atmosphere")):
            return attenuation_of_visibility(air.visibility_km)

    def _tower(self) -> Tower | None:
        tower = self.entries.tower
        return None if tower is None else tower.tower()

    # --- heliostats

    def _layout(self, mistakes: Mistakes) -> list[PlacedHeliostat]:
        layout = self.entries.layout
        if layout.file is not None:
            placed = read_layout(self.text.file(layout.file, "layout", "file"), mistakes)
        else:
            placed = [
                PlacedHeliostat(self._place("layout", "heliostats", index), entry)
                for index, entry in enumerate(layout.heliostats or ())
            ]
        _require_different(placed, mistakes)
        return placed

    def _receiver_of(
        self, layout: list[PlacedHeliostat], goals: dict[str, AnyReceiver]
    ) -> dict[str, str]:
        if not goals:
            raise InvalidInputError(
                f"{self._place()}: has neither receivers nor targets; heliostats need something to"
                " aim at"
            )
        first = next(iter(goals))
        return {placed.entry.name: placed.entry.receiver or first for placed in layout}

    def _heliostats(
        self,
        layout: list[PlacedHeliostat],
        types: dict[str, HeliostatType],
        goals: dict[str, AnyReceiver],
        receiver_of: dict[str, str],
    ) -> dict[str, Heliostat]:
        heliostats, mistakes = {}, Mistakes()
        for placed in layout:
            entry = placed.entry
            with mistakes.collected():
                goal = goals[receiver_of[entry.name]]
                heliostats[entry.name] = place_heliostat(placed, types[entry.type], goal)
        mistakes.require_none()
        return heliostats


def _check_names(layout: list[PlacedHeliostat], entries: PlantDocument, mistakes: Mistakes) -> None:
    """Collect types and receivers of heliostats that the document does not have."""
    types, goals = list(entries.heliostat_types), [*entries.receivers, *entries.targets]
    for placed in layout:
        kind, goal = placed.entry.type, placed.entry.receiver
        if kind not in types:
            mistakes.found.append(
                f"{placed.place}: type: {kind[:60]!r} is no heliostat type; {nearest(kind, types)}"
            )
        if goals and goal and goal not in goals:
            mistakes.found.append(
                f"{placed.place}: receiver: {goal!r} is no receiver or target;"
                f" {nearest(goal, goals)}"
            )


def _require_different(layout: list[PlacedHeliostat], mistakes: Mistakes) -> None:
    """Collect heliostats of one name, or within a centimetre of one place."""
    names: dict[str, str] = {}
    places: dict[tuple[float, ...], PlacedHeliostat] = {}
    for placed in layout:
        entry = placed.entry
        if entry.name in names:
            mistakes.found.append(
                f"{placed.place}: name: {entry.name} is there twice, first in"
                f" {names[entry.name]}; rename one"
            )
        foot = tuple(round(value, 2) for value in (entry.east_m, entry.north_m, entry.up_m))
        if foot in places:
            mistakes.found.append(
                f"{placed.place}: {entry.name} is at the place of {places[foot].entry.name},"
                f" {places[foot].place}; move or remove one"
            )
        names[entry.name], places[foot] = placed.place, placed


def place_heliostat(
    placed: PlacedHeliostat, of_type: HeliostatType, goal: AnyReceiver
) -> Heliostat:
    """The heliostat of a type at its place, canted and focused to a receiver or target.

    Raises
    ------
    InvalidInputError
        If it is too near to its aim, or the model refuses it.
    """
    entry = placed.entry
    foot = np.array([entry.east_m, entry.north_m, entry.up_m])
    aim = goal.aim_of(foot)
    pivot = foot + np.array([0.0, 0.0, of_type.mount.pivot_height])
    if math.dist(aim, pivot) < _NEAREST:
        raise InvalidInputError(
            f"{placed.place}: {entry.name} is less than {_NEAREST:g} m from its aim on {goal.name};"
            " move one of them"
        )
    with mistakes_at(placed.place):
        return of_type.heliostat(entry.name, foot, aim, entry.focal_length_m)


def _warnings(text: PlantText, layout: list[PlacedHeliostat]) -> Iterable[str]:
    used = {placed.entry.type for placed in layout}
    for name in text.entries.heliostat_types:
        if name not in used:
            yield f"{text.place('heliostat_types', name)}: has no heliostat in the layout"


def _files(entries: PlantDocument) -> Sequence[str]:
    """Files that the document names, each once."""
    facets = [entry.facets for entry in entries.heliostat_types.values()]
    named = [one.file for one in facets if isinstance(one, FacetFileEntry)]
    layout = entries.layout.file
    return tuple(dict.fromkeys([*([] if layout is None else [layout]), *named]))
