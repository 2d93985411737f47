"""A plant with its photographs: surfaces, forecasts, comparisons and studies."""

from collections.abc import Collection, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Literal, Self
from weakref import finalize

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import ArrayLike

from heliotwin.arguments import (
    SunLike,
    require_folder,
    require_heights,
    require_known,
    require_point,
    require_positive,
    require_resolution,
    resolve_sun,
)
from heliotwin.demo.photographs import IMAGES, RAYS
from heliotwin.demo.plant import write_plant
from heliotwin.folder_forecast import agreement, forecast_measurement
from heliotwin.folder_store import FolderStore, ForecastTarget, open_folder
from heliotwin.folder_study import study_photographs
from heliotwin.results import Comparison, Flux, Photograph, StudyResult, Surface, new_axes
from model.effects import CATALOGUE, Effect
from model.effects.catalogue import effects_from_json
from model.errors import InvalidInputError
from model.plant import Receiver, TargetPlane, require_plane_shape
from model.study import StudyOptions
from model.surface import DEGREE, control_points
from service.base.choices import Method, require_images
from service.drawing.pictures import draw_places
from service.sources.documents import IMAGE_KINDS
from service.sources.folder import MeasuredSurface, MeasurementFolder, measured_heights, read_folder
from service.store.tables import MeasurementRow
from service.twin.measurements import accepted_measurement, to_observations
from service.twin.surfaces.prediction import choose_observations


def open_plant(
    folder: str | Path, heliostats: Sequence[str] | None = None, *, mounts: str | Path | None = None
) -> "PlantFolder":
    """Open a measurement folder.

    Parameters
    ----------
    folder : str or Path
        Its root, as PAINT lays it out. ``twin.json`` in it declares the plant's model.
    heliostats : sequence of str, optional
        Names of the heliostats to read; all by default.
    mounts : str or Path, optional
        File of ``heliotwin calibrate``; by default the mounts of the heliostats' properties.

    Returns
    -------
    PlantFolder

    Raises
    ------
    InvalidInputError
        If the folder is of no known layout, or no heliostat can be read.

    Examples
    --------
    >>> plant = heliotwin.open_plant("out/demo/plant")
    >>> plant.heliostats, plant.targets
    (('AB12', 'AC31', 'AF27', 'AK08'), ('calibration_target',))
    """
    names = None if heliostats is None else list(heliostats)
    read = read_folder(require_folder(folder), names)
    return PlantFolder(read, mounts=None if mounts is None else Path(mounts))


def make_demo(folder: str | Path, *, images: int = IMAGES, rays: int = RAYS) -> "PlantFolder":
    """Open the demonstration's plant. It is made first if the folder does not exist.

    Its four mirrors are known, and a Monte Carlo tracer photographs them.

    Parameters
    ----------
    folder : str or Path
    images : int
        Photographs of each heliostat.
    rays : int
        Of each photograph.

    Returns
    -------
    PlantFolder
    """
    if not Path(folder).exists():
        write_plant(Path(folder), images=images, rays=rays)
    return open_plant(folder)


def plane(
    center_m: ArrayLike,
    normal: ArrayLike,
    width_m: float,
    height_m: float,
    up: ArrayLike = (0.0, 0.0, 1.0),
) -> TargetPlane:
    """A rectangle anywhere that light falls on.

    Parameters
    ----------
    center_m : (3,) [m]
        East, north, up of the tower base.
    normal : (3,)
        Of the lit side, in the same frame; of any length.
    width_m, height_m : float [m]
    up : (3,)
        Upward direction of the map, not parallel to ``normal``.

    Returns
    -------
    TargetPlane

    Examples
    --------
    >>> heliotwin.plane((0, 5, 30), normal=(0, 1, 0), width_m=6, height_m=6).width
    6.0
    """
    width, height = (
        require_positive(name, value, "m")
        for name, value in (("width_m", width_m), ("height_m", height_m))
    )
    require_plane_shape(width, height)
    center, axis, top = (
        np.array(require_point(name, value))
        for name, value in (("center_m", center_m), ("normal", normal), ("up", up))
    )
    return TargetPlane("plane", center, axis, top, width, height)


class PlantFolder:
    """A plant with its measurement folder; see `open_plant`.

    Photographs are measured when they are first needed, and kept until the plant is closed.
    """

    def __init__(
        self, folder: MeasurementFolder, effects: Sequence[Effect] = (), mounts: Path | None = None
    ) -> None:
        self._folder, self._effects, self._mounts = folder, tuple(effects), mounts
        self._stores: dict[tuple[bool, bool], FolderStore] = {}
        self._stack = ExitStack()
        self.close = finalize(self, self._stack.close)
        """Delete what was measured; also done when the plant is no longer used."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def heliostats(self) -> Sequence[str]:
        """Names of the heliostats."""
        return tuple(name for name in self._folder.plant.heliostats if name not in self.skipped)

    @property
    def targets(self) -> Sequence[str]:
        """Names of the targets and receivers."""
        return (*self._folder.plant.targets, *self._folder.plant.receivers)

    @property
    def skipped(self) -> dict[str, str]:
        """Heliostats and measurements that could not be read, with the reasons."""
        return self._folder.skipped

    def __repr__(self) -> str:
        name, targets = self._folder.plant.name, ", ".join(self.targets)
        return f"PlantFolder({name}: {len(self.heliostats)} heliostats, {targets})"

    def plot(
        self, values: Mapping[str, float] | None = None, label: str = "", ax: Axes | None = None
    ) -> Axes:
        """Draw the field from above, with the tower as a triangle.

        Parameters
        ----------
        values : mapping of str to float, optional
            What the dots are coloured by, by heliostat; heliostats without a value are hollow.
        label : str
            What the values are, with their unit.
        ax : matplotlib.axes.Axes, optional
            By default those of a new figure.

        Returns
        -------
        matplotlib.axes.Axes
        """
        axes, shown = new_axes(ax), {self._known(name): v for name, v in (values or {}).items()}
        plant = self._folder.plant
        places = np.array([plant.heliostats[name].position[:2] for name in self.heliostats])
        heights = np.array([shown.get(name, np.nan) for name in self.heliostats], dtype=float)
        ends = (min(shown.values(), default=0.0), max(shown.values(), default=1.0))
        draw_places(axes, places, heights, "viridis", ends, label)
        axes.plot(0, 0, "k^")
        return axes

    def with_effects(self, study: StudyResult) -> "PlantFolder":
        """The same plant with what a study found in its model: effects, or a correction."""
        found = effects_from_json({**study.report, "effects": study.effects})
        return PlantFolder(self._folder, (*self._effects, *found), self._mounts)

    def surface(
        self, heliostat: str, z: Literal["measured", "ideal"] | ArrayLike = "measured"
    ) -> Surface:
        """A surface that is known.

        Parameters
        ----------
        heliostat : str
        z : str or (F, 8, 8) [m]
            "measured": the folder's measured one; "ideal": the canted facets without errors; or
            control heights.

        Returns
        -------
        Surface

        Examples
        --------
        >>> plant.surface("AB12").control_points.shape
        (4, 8, 8, 3)
        """
        mirror = self._folder.plant.heliostats[self._known(heliostat)]
        if isinstance(z, str):
            require_known("z", z, ("measured", "ideal"))
        if isinstance(z, str) and z == "measured":
            measured = self._measured(heliostat)
            if measured is None:
                raise InvalidInputError(
                    f"z: the folder has no measured surface of {heliostat}; give 'ideal' or"
                    " heights, or predict one"
                )
            return measured
        facets = len(mirror.facets)
        heights = np.zeros((facets, 8, 8)) if isinstance(z, str) else require_heights(z, facets)
        source: Literal["ideal", "given"] = "ideal" if isinstance(z, str) else "given"
        return Surface(heliostat, source, heights, control_points(mirror, heights), DEGREE)

    def photographs(self, heliostat: str) -> list[Photograph]:
        """The accepted photographs of a heliostat, in the order of their identifiers."""
        return [self._photograph(row, heliostat) for row in self._rows(heliostat)]

    def predict(
        self, heliostat: str, method: Method = "network", images: int | Sequence[str] = 8
    ) -> Surface:
        """Predict the mirror surface of a heliostat from its photographs.

        Parameters
        ----------
        heliostat : str
        method : str
            "network": at once, from up to 8 photographs; "refined": fitted through the ray tracer,
            from up to 64.
        images : int or sequence of str
            How many photographs to take, with suns far apart; or their identifiers.

        Returns
        -------
        Surface

        Examples
        --------
        >>> surface = plant.predict("AB12", images=["101", "102", "103"])
        >>> surface.images
        ('101', '102', '103')
        """
        rows, store = self._rows(heliostat), self._store()
        named = [] if isinstance(images, int) else list(images)
        count = images if isinstance(images, int) else len(named)
        require_images(method, count)
        if not rows:
            raise InvalidInputError(
                f"heliostat: {heliostat} has no photograph that was accepted; see skipped"
            )
        twin = store.context(heliostat)
        for name in named:
            require_known("images", name, [row.identifier for row in rows])
        with store.runtime.computing(f"predict_{method}") as operations:
            if named:
                taken = [row for row in rows if row.identifier in named]
                chosen = to_observations(
                    [accepted_measurement(row, twin.origin) for row in taken], twin.heliostat
                )
            else:
                chosen, _ = choose_observations(operations, twin, rows, count)
            found = operations.predict(twin.heliostat, chosen, twin.model, method)
        return Surface(
            heliostat,
            method,
            found.z,
            found.control_points,
            z_std=found.z_std,
            images=found.used,
            misfit=found.misfit,
            warnings=found.warnings,
        )

    def forecast(
        self,
        surface: Surface,
        on: str | Receiver,
        sun: SunLike,
        *,
        aim_m: ArrayLike | None = None,
        dni_w_m2: float = 1000.0,
        resolution: Sequence[int] = (256, 256),
    ) -> Flux:
        """Trace the flux of a heliostat on a plane, with the plant's model.

        Parameters
        ----------
        surface : Surface
        on : str or TargetPlane
            Name of a target or receiver, or a `plane`.
        sun : datetime or (2,) [deg]
            A time with a zone; or azimuth from north over east, and elevation.
        aim_m : (3,) [m], optional
            Where the mirror's centre aims: east, north, up; by default the plane's centre.
        dni_w_m2 : float [W/m2]
            Direct normal irradiance.
        resolution : (int, int)
            Rows and columns of the map.

        Returns
        -------
        Flux

        Raises
        ------
        InvalidInputError
            If an argument is wrong.
        HeliotwinError
            If the heliostat cannot reach the plane.

        Examples
        --------
        >>> noon = datetime(2026, 6, 21, 11, 36, tzinfo=timezone.utc)
        >>> board = heliotwin.plane((0, 5, 30), normal=(0, 1, 0), width_m=6, height_m=6)
        >>> plant.forecast(surface, on=board, sun=noon, resolution=(64, 64)).flux.shape
        (64, 64)
        """
        name = self._known(surface.heliostat)
        receiver = self._receiver(on)
        position, at = resolve_sun(sun, self._folder.plant.origin)
        wanted = ForecastTarget(
            position,
            receiver,
            at,
            aim=None if aim_m is None else np.asarray(require_point("aim_m", aim_m)),
            dni_w_m2=require_positive("dni_w_m2", dni_w_m2, "W/m2"),
            resolution=require_resolution(resolution),
        )
        mirror = MeasuredSurface(surface.control_points, surface.degree)
        traced = self._store(with_photographs=False).trace(name, mirror, wanted)
        is_plane = isinstance(receiver, TargetPlane)
        return Flux(
            traced.flux,
            (receiver.width, receiver.height),
            traced.peak,
            traced.power,
            traced.center_of_mass if is_plane else None,
            traced.camera_view if is_plane else None,
            (position.azimuth_deg, position.elevation_deg),
        )

    def compare(self, surface: Surface) -> list[Comparison]:
        """Forecast the photographs of a heliostat, and compare them with the measured flux.

        Photographs that show only the centred flux are left out.

        Parameters
        ----------
        surface : Surface

        Returns
        -------
        list of Comparison

        Examples
        --------
        >>> min(one.accuracy for one in plant.compare(plant.surface("AB12"))) > 0.9
        True
        """
        rows, store = self._rows(surface.heliostat), self._store()
        twin, found = store.context(surface.heliostat), []
        for row in rows:
            mirror = MeasuredSurface(surface.control_points, surface.degree)
            traced = forecast_measurement(store, twin, row, mirror)
            taken = accepted_measurement(row, twin.origin)
            agreed = agreement(taken, traced, taken.target)
            found.append(
                Comparison(
                    self._photograph(row, surface.heliostat),
                    traced.camera_view,
                    agreed.accuracy,
                    agreed.window,
                    row.identifier not in surface.images,
                )
            )
        return found

    def study(
        self, surfaces: Sequence[Surface] | None = None, candidates: Collection[str] | None = None
    ) -> StudyResult:
        """Find the effect that the photographs show and the plant's model lacks.

        Parameters
        ----------
        surfaces : sequence of Surface, optional
            One for each heliostat to study; by default the measured ones of all that have one.
        candidates : collection of str, optional
            Names of the effects to try; the whole catalogue by default.

        Returns
        -------
        StudyResult

        Raises
        ------
        InvalidInputError
            If there are too few photographs, or an unknown candidate.

        Examples
        --------
        >>> found = plant.study(candidates=["camera_response", "slope_error"])
        >>> better = plant.with_effects(found)
        """
        for name in candidates or ():
            require_known("candidates", name, CATALOGUE)
        names = tuple(CATALOGUE) if candidates is None else tuple(candidates)
        store = self._store(with_camera=False)  # the camera is a candidate
        if surfaces is None:
            surfaces = [one for name in self.heliostats if (one := self._measured(name))]
        mirrors = [
            (self._known(one.heliostat), one.control_points, one.degree, one.images)
            for one in surfaces
        ]
        inputs = store.study_inputs(mirrors, self.skipped | store.refused)
        options = StudyOptions(candidates=names)
        report = study_photographs(store, inputs, options).to_json()
        before, after = (report[name]["accuracy_mean"] for name in ("before", "after"))
        effects = report["effects"]
        return StudyResult(report["verdict"], report["conclusion"], effects, before, after, report)

    def _known(self, heliostat: str) -> str:
        return require_known("heliostat", heliostat, self.heliostats)

    def _receiver(self, on: str | Receiver) -> Receiver:
        if not isinstance(on, str) and hasattr(on, "touching"):
            return on
        plant = self._folder.plant
        known: dict[str, Receiver] = {**plant.targets, **plant.receivers}
        return known[require_known("on", on, known)]

    def _measured(self, heliostat: str) -> Surface | None:
        """The measured surface of a heliostat, if the folder has one."""
        known = self._folder.measured_surface(heliostat)
        if known is None:
            return None
        heights = measured_heights(self._folder.plant.heliostats[heliostat], known)
        return Surface(heliostat, "measured", heights, known.points, known.degree)

    def _store(self, with_photographs: bool = True, with_camera: bool = True) -> FolderStore:
        """The folder in a temporary store, with or without measured photographs.

        They choose the camera if none is declared, except without ``with_camera``.
        """
        if not self.close.alive:
            raise InvalidInputError("the plant is closed; open it again by open_plant")
        key = (with_photographs, with_camera)
        if key not in self._stores:
            kinds = IMAGE_KINDS if with_photographs else None
            opened = open_folder(
                self._folder, kinds, self._effects, self._mounts, with_camera=with_camera
            )
            self._stores[key] = self._stack.enter_context(opened)
        return self._stores[key]

    def _rows(self, heliostat: str) -> list[MeasurementRow]:
        return self._store().photographs(self._known(heliostat))[0]

    def _photograph(self, row: MeasurementRow, heliostat: str) -> Photograph:
        taken = accepted_measurement(row, self._store().context(heliostat).origin)
        sun = (row.sun_azimuth_deg, row.sun_elevation_deg)
        return Photograph(
            row.identifier, row.target.name, sun, row.taken_at, taken.flux, taken.centered
        )
