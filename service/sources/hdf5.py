"""HDF5 files of others: safe access to their datasets, and measured mirrors of deflectometry.

Datasets have a bounded size, and none are in other files. Measured mirrors are PAINT's files, and
those of OpenCSP's SOFAST. Both have points and slopes of the mirror. Heights are fitted to all
slopes of a facet at once, by least squares in the basis of `model.surface`.

Sources: the PAINT database of the Solar Tower Juelich; Sandia National Laboratories, OpenCSP,
``opencsp.app.sofast.lib.ProcessSofastAbstract`` and ``calculation_data_classes``.
"""

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import h5py
import numpy as np
from numpy.typing import NDArray

from model.errors import InvalidInputError
from model.plant import Heliostat
from model.surface import COLUMNS, ROWS, fit_heights, nominal_heights
from service.base.validation import escape_control_characters
from service.sources.files import file_name, require_regular

Array = NDArray[np.float64]

_MAX_TEXT_BYTES = 4096
_MAX_MEMBERS = 100_000


@contextmanager
def open_hdf5(file: Path) -> Iterator["Hdf5Group"]:
    """Open an HDF5 file for reading.

    Raises
    ------
    InvalidInputError
        If it is none, or damaged.
    """
    try:
        with h5py.File(require_regular(file), "r") as data:
            yield Hdf5Group(data, file_name(file))
    except InvalidInputError:
        raise
    except (OSError, KeyError, RuntimeError, ValueError) as error:
        raise InvalidInputError(f"{file_name(file)}: no readable HDF5 file ({error})") from None


@dataclass(frozen=True, eq=False)
class Hdf5Group:
    """A group of an HDF5 file; messages name the ``file`` and the path inside of it.

    Links, also those to other files, are rejected before they are followed.
    """

    members: h5py.Group
    file: str

    @property
    def place(self) -> str:
        """The file, and the path inside of it."""
        path = escape_control_characters(str(self.members.name).lstrip("/"))[:200]
        return f"{self.file}, {path}" if path else self.file

    def __contains__(self, name: str) -> bool:
        return name in self.members

    @property
    def names(self) -> list[str]:
        """Names of its members in order."""
        if len(self.members) > _MAX_MEMBERS:
            raise self.refuse(f"has {len(self.members)} members; at most {_MAX_MEMBERS} are read")
        return sorted(self.members.keys())

    def refuse(self, problem: str) -> InvalidInputError:
        """The error of something that is not understood."""
        return InvalidInputError(f"{self.place}: {problem}")

    def group(self, path: str) -> "Hdf5Group":
        """The group of a path ``a/b/c``."""
        found = self
        for name in path.split("/"):
            member = found._member(name)
            if not isinstance(member, h5py.Group):
                raise found.refuse(f"'{name}' must be a group")
            found = Hdf5Group(member, self.file)
        return found

    def groups(self) -> dict[str, "Hdf5Group"]:
        """All members, which must be groups, by name."""
        return {name: self.group(name) for name in self.names}

    def numbers(
        self, name: str, shape: Sequence[int | None], most: int, unit: str = "values"
    ) -> Array:
        """Numbers of a dataset; None in ``shape`` is any length.

        At most ``most`` values are read; ``unit`` is what the message calls a row of them.
        """
        found = self._dataset(name)
        fits = found.shape is not None and len(found.shape) == len(shape)
        fits = fits and all(n in (None, m) for n, m in zip(shape, found.shape, strict=True))
        if found.dtype.kind not in "fiu" or not fits:
            asked = ", ".join("n" if n is None else str(n) for n in shape)
            asked = f"shape ({asked}{',' * (len(shape) == 1)})" if shape else "no dimension"
            raise self.refuse(
                f"'{name}' must be numbers of {asked}, got {found.dtype} {found.shape}"
            )
        declared = max(math.prod(found.shape), math.prod(found.chunks or (0,)))
        if declared > most or found.dtype.itemsize > 8:
            row = math.prod(n for n in shape if n is not None)
            raise self.refuse(
                f"'{name}' declares the shape {found.shape}; at most {most // row} {unit} are read"
            )
        return np.asarray(found[()], dtype=np.float64)

    def number(self, name: str) -> float:
        """The finite number of a dataset without a dimension."""
        value = float(self.numbers(name, (), 1))
        if not math.isfinite(value):
            raise self.refuse(f"'{name}' must be finite, got {value}")
        return value

    def dimensions(self, name: str) -> int:
        """Number of a dataset's dimensions."""
        return len(self._dataset(name).shape or ())

    def truth(self, name: str) -> bool:
        """The truth value of a dataset."""
        found = self._dataset(name)
        if found.shape != () or found.dtype.kind != "b":
            raise self.refuse(f"'{name}' must be true or false, got {found.dtype} {found.shape}")
        return bool(found[()])

    def text(self, name: str) -> str:
        """The text of a dataset."""
        found = self._dataset(name)
        if found.shape != () or found.dtype.kind not in "OS" or found.dtype.itemsize > 4096:
            raise self.refuse(f"'{name}' must be text, got {found.dtype} {found.shape}")
        value = found[()]
        if not isinstance(value, bytes) or len(value) > _MAX_TEXT_BYTES:
            raise self.refuse(f"'{name}' must be a short text")
        return value.decode("utf-8", "replace")

    def _dataset(self, name: str) -> h5py.Dataset:
        found = self._member(name)
        if not isinstance(found, h5py.Dataset):
            raise self.refuse(f"'{name}' must be a dataset")
        if found.external or found.is_virtual:
            raise self.refuse(
                f"the numbers of '{name}' are in another file; copy them into this one"
            )
        return found

    def _member(self, name: str) -> object:
        """A member; raises InvalidInputError if it is missing, or a link."""
        link = self.members.get(name, getlink=True)
        if link is None:
            raise self.refuse(f"'{name}' is missing")
        if not isinstance(link, h5py.HardLink):
            raise self.refuse(f"'{name}' is a link; copy what it links to into this file")
        return self.members[name]


# --- deflectometry
# --------------------------------------------------------------------------------------------------


# Most points per facet; SOFAST has one for each pixel of a camera.
_MAX_POINTS = 500_000
_MIN_POINTS = 256

SOFAST_SHAPE = (13, 13)
"""Heights of a facet that SOFAST measured: half the spacing of those of photographs."""

_SOFAST = "DataSofastCalculation"
_ENSEMBLE = "CalculationEnsemble"
_SLOPES = "SlopeSolverData"
# Size of the measured part of a facet, in facets of the plant.
_LEAST_EXTENT, _MOST_EXTENT = 0.8, 1.05
# Largest distance between a facet's measured and its ideal place, in facets.
_MOST_SHIFT = 0.25


class MirrorPoints(NamedTuple):
    """Points (n, 3) [m] of a facet and normals (n, 3) of any length, in mirror coordinates, and
    the ``place`` in the file.
    """

    points: Array
    normals: Array
    place: str


def read_deflectometry(file: Path, heliostat: Heliostat) -> Array:
    """Fit heights z (F, I, J) [m] over the ideal facets to the deflectometry of each facet.

    PAINT's ``facet1``, ... have points and normals in mirror coordinates: (F, 8, 8). SOFAST's
    results have finer details: (F, 13, 13).

    Raises
    ------
    InvalidInputError
        It names the file, the place in it, and what to do.
    """
    with open_hdf5(file) as data:
        if _SOFAST in data:
            facets, shape = _sofast(data.group(f"{_SOFAST}/facet"), heliostat), SOFAST_SHAPE
        else:
            facets, shape = list(_paint(data, len(heliostat.facets))), (ROWS, COLUMNS)
    frames = zip(*heliostat.facet_frames, facets, strict=True)
    fitted = np.array([_fitted(*frame, shape) for frame in frames])
    if any(facet.focal_length for facet in heliostat.facets):
        fitted = fitted - nominal_heights(heliostat, shape)
    return fitted


def _fitted(
    center: Array, axes: Array, half_size: Array, facet: MirrorPoints, shape: tuple[int, int]
) -> Array:
    """Heights (*shape) [m] over the plane of an ideal facet."""
    points, normals = (vectors @ axes.T for vectors in (facet.points, facet.normals))
    u, v = ((points - axes @ center)[:, :2] / (2 * half_size) + 0.5).T
    inside = (u >= 0) & (u <= 1) & (v >= 0) & (v <= 1) & np.isfinite(normals).all(axis=-1)
    if inside.sum() < _MIN_POINTS:
        raise InvalidInputError(
            f"{facet.place}: only {inside.sum()} usable points on the facet, {_MIN_POINTS} are"
            " needed"
        )
    return fit_heights(u[inside], v[inside], normals[inside], half_size, shape)


# --- PAINT
# --------------------------------------------------------------------------------------------------


def _paint(data: Hdf5Group, count: int) -> Iterator[MirrorPoints]:
    for index in range(1, count + 1):
        facet = data.group(f"facet{index}")
        points, normals = (
            facet.numbers(name, (None, 3), 3 * _MAX_POINTS, "points")
            for name in ("surface_points", "surface_normals")
        )
        if len(points) != len(normals):
            raise facet.refuse(f"has {len(points)} points and {len(normals)} normals")
        yield MirrorPoints(points, normals, facet.place)


# --- SOFAST
# --------------------------------------------------------------------------------------------------


def _sofast(measured: Hdf5Group, heliostat: Heliostat) -> list[MirrorPoints]:
    """SOFAST's facets in the order of the heliostat's.

    A facet that was measured alone has no canting: SOFAST turns it level at its alignment point.
    It gets the heliostat's. Facets of an ensemble have places and canting.
    """
    facets, count = list(measured.groups().values()), len(heliostat.facets)
    if len(facets) != count:
        raise measured.refuse(
            f"has {len(facets)} facets, heliostat {heliostat.name} has {count}; measure all"
            " facets in one ensemble, or describe the mirror as it was measured"
        )
    if count == 1 and _ENSEMBLE not in facets[0]:
        return [_single(facets[0], heliostat)]
    ensemble = [_of_ensemble(facet) for facet in facets]
    return _in_order(ensemble, heliostat)


def _single(facet: Hdf5Group, heliostat: Heliostat) -> MirrorPoints:
    solved = facet.group(_SLOPES)
    points, normals = _vectors(solved, "v_surf_points_facet", "slopes_facet_xy")
    center, axes, half_size = (values[0] for values in heliostat.facet_frames)
    _require_size(solved.place, points, half_size)
    return MirrorPoints(center + points @ axes, normals @ axes, solved.place)


def _of_ensemble(facet: Hdf5Group) -> MirrorPoints:
    if _ENSEMBLE not in facet:
        raise facet.refuse(
            f"'{_ENSEMBLE}' is missing, which has the facet's place; process the mirror as an"
            " ensemble of facets"
        )
    solved = facet.group(_ENSEMBLE)
    found = _vectors(solved, "v_surf_points_ensemble", "slopes_ensemble_xy")
    return MirrorPoints(*found, solved.place)


class _Vectors(NamedTuple):
    points: Array
    normals: Array


def _vectors(group: Hdf5Group, points: str, slopes: str) -> _Vectors:
    """Points and normals (n, 3) of SOFAST's (3, n) and of slopes (2, n) along x and y."""
    places = group.numbers(points, (3, None), 3 * _MAX_POINTS, "points").T
    along_x, along_y = group.numbers(slopes, (2, None), 2 * _MAX_POINTS, "points")
    if len(places) != len(along_x):
        raise group.refuse(f"'{points}' has {len(places)} points, '{slopes}' has {len(along_x)}")
    return _Vectors(places, np.stack([-along_x, -along_y, np.ones_like(along_x)], axis=-1))


def _in_order(ensemble: list[MirrorPoints], heliostat: Heliostat) -> list[MirrorPoints]:
    """Each ideal facet's measured one: the nearest, which must be near."""
    centers, axes, half_sizes = heliostat.facet_frames
    middles = np.array([(_extent(f.points).sum(axis=0)) / 2 for f in ensemble])
    found: list[MirrorPoints] = []
    for number, center in enumerate(centers):
        apart = np.abs((middles - center)[:, :2]) / (2 * half_sizes[number])
        nearest = int(apart.max(axis=1).argmin())
        facet = ensemble[nearest]
        if not apart[nearest].max() < _MOST_SHIFT:
            raise InvalidInputError(
                f"{facet.place}: no measured facet is at ({center[0]:.3f}, {center[1]:.3f}) m,"
                f" where facet {number + 1} of {heliostat.name} is; the nearest is at"
                f" ({middles[nearest][0]:.3f}, {middles[nearest][1]:.3f}) m. Correct the facets of"
                " its type"
            )
        _require_size(facet.place, (facet.points - center) @ axes[number].T, half_sizes[number])
        found.append(facet)
    return found


def _extent(points: Array) -> Array:
    """Least and largest coordinates (2, 3) [m] of points."""
    return np.stack([np.nanmin(points, axis=0), np.nanmax(points, axis=0)])


def _require_size(place: str, points: Array, half_size: Array) -> None:
    """Refuse points (n, 3) [m] in the frame of a facet that is larger or smaller than they are."""
    low, high = _extent(points)[:, :2]
    share = (high - low) / (2 * half_size)
    if not ((share > _LEAST_EXTENT) & (share < _MOST_EXTENT)).all():
        raise InvalidInputError(
            f"{place}: measures {high[0] - low[0]:.3f} x {high[1] - low[1]:.3f} m, the plant's"
            f" facet is {2 * half_size[0]:.3f} x {2 * half_size[1]:.3f} m; correct the facets of"
            " its type, or take the file of this mirror"
        )
