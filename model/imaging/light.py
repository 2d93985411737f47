"""Camera response curves: conversion between counts and linear intensity ("light").

A consumer camera encodes light by a curve (its transfer function) before it stores counts. On a
target in daylight, spot and daylight go through that curve together. So a difference of counts is
not proportional to a difference of light. Photographs are therefore converted to light first, and
the daylight is subtracted afterwards.

Counts and light are relative here: to the largest count and to the light at that count, from 0 to
1. The exposure is the unit of light. It is unknown, so all later steps normalise.

Source: IEC 61966-2-1 (sRGB); Debevec and Malik, *Recovering high dynamic range radiance maps from
photographs*, SIGGRAPH 1997. On two years' photographs of one mirror the sRGB curve raises the
accuracy of forecasts from 0.869 to 0.899 without a fitted number (RESULTS.md).
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from model.errors import InvalidInputError

Array = NDArray[np.float64]


class Transfer(ABC):
    """A transfer function from (0, 0) to (1, 1), increasing; a frozen dataclass of numbers."""

    @abstractmethod
    def light(self, counts: ArrayLike) -> Array:
        """Convert ``counts`` (...) [1] to light (...) [1]."""

    @abstractmethod
    def counts(self, light: ArrayLike) -> Array:
        """Convert ``light`` (...) [1] to counts (...) [1].

        Light above the range gives the largest count.
        """


@dataclass(frozen=True)
class Srgb(Transfer):
    """The sRGB curve, which nearly every 8-bit camera uses."""

    def light(self, counts: ArrayLike) -> Array:
        """Decode by IEC 61966-2-1, section 5.2."""
        share = np.asarray(counts, dtype=np.float64)
        return np.where(
            share <= 0.04045, share / 12.92, ((np.maximum(share, 0) + 0.055) / 1.055) ** 2.4
        )

    def counts(self, light: ArrayLike) -> Array:
        """Encode by IEC 61966-2-1, section 5.3."""
        share = np.clip(light, 0, 1).astype(np.float64)
        return np.where(share <= 0.0031308, share * 12.92, 1.055 * share ** (1 / 2.4) - 0.055)


@dataclass(frozen=True)
class Power(Transfer):
    """Light is counts to the power ``gamma``; a linear camera has 1."""

    gamma: float = 1.0

    def __post_init__(self) -> None:
        if not 0.2 <= self.gamma <= 5:
            raise InvalidInputError(f"a camera's gamma must lie in [0.2, 5], got {self.gamma}")

    def light(self, counts: ArrayLike) -> Array:
        """Raise counts to the power."""
        return np.asarray(np.maximum(counts, 0) ** self.gamma, dtype=np.float64)

    def counts(self, light: ArrayLike) -> Array:
        """Apply the inverse power."""
        return np.asarray(np.clip(light, 0, 1) ** (1 / self.gamma), dtype=np.float64)


@dataclass(frozen=True)
class Measured(Transfer):
    """A measured curve: ``lights`` at ``shares`` of the largest count.

    Both increase from 0 to 1, and the curve is linear between them.
    """

    shares: tuple[float, ...]
    lights: tuple[float, ...]

    def __post_init__(self) -> None:
        for what, values in (("counts", self.shares), ("light", self.lights)):
            numbers = np.asarray(values, dtype=np.float64)
            if (
                len(numbers) < 2
                or not np.isfinite(numbers).all()
                or (numbers[0], numbers[-1]) != (0, 1)
            ):
                raise InvalidInputError(
                    f"a camera's '{what}' must be at least two finite numbers from 0 to 1"
                )
            if not (np.diff(numbers) > 0).all():
                raise InvalidInputError(
                    f"a camera's '{what}' must rise from each number to the next"
                )
        if len(self.shares) != len(self.lights):
            raise InvalidInputError("a camera's 'counts' and 'light' must be of one length")

    def light(self, counts: ArrayLike) -> Array:
        """Interpolate linearly."""
        return np.asarray(np.interp(np.asarray(counts, dtype=np.float64), self.shares, self.lights))

    def counts(self, light: ArrayLike) -> Array:
        """Interpolate linearly."""
        return np.asarray(np.interp(np.asarray(light, dtype=np.float64), self.lights, self.shares))


LINEAR = Power(1.0)

USUAL_AMBIENT = 0.53
"""Counts [1] of a target in daylight.

The median of 86 photographs over two years; their range is 0.44 to 0.66.
"""


@dataclass(frozen=True)
class Camera:
    """How a camera converts light to counts, from when on, and for which targets.

    Attributes
    ----------
    transfer : Transfer or None
        None: sRGB for 8 bits, linear for more.
    ambient : float [1]
        Counts of the sheet in daylight, for images whose background was subtracted in counts.
    since : datetime or None
        With time zone; None: always.
    targets : tuple of str
        Names of the targets that it photographs; empty: all.
    peak_counts : float [1]
        Counts of the sheet at the spot's brightest position, for images whose background was
        subtracted in counts. Such images are stretched, so they do not show it.
    bits : int or None
        Bits of its counts in 16-bit files; None: they were scaled to 16.
    """

    transfer: Transfer | None = None
    ambient: float = USUAL_AMBIENT
    since: datetime | None = None
    targets: tuple[str, ...] = ()
    peak_counts: float = 1.0
    bits: int | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.ambient < 1:
            raise InvalidInputError(
                f"a camera's 'ambient' must lie in [0, 1) of its counts, got {self.ambient}"
            )
        if not self.ambient < self.peak_counts <= 1:
            raise InvalidInputError(
                f"a camera's 'peak_counts' must lie above its ambient {self.ambient}, up to 1, got"
                f" {self.peak_counts}"
            )
        if self.bits is not None and not 8 < self.bits <= 16:
            raise InvalidInputError(f"a camera's 'bits' must lie in 9 to 16, got {self.bits}")

    def law(self, depth: DTypeLike) -> Transfer:
        """The transfer function for files of a depth, uint8 or uint16."""
        return self.transfer or (Srgb() if depth == np.uint8 else LINEAR)

    def most(self, depth: DTypeLike) -> int:
        """The largest count in files of a depth."""
        return 255 if depth == np.uint8 else (1 << (self.bits or 16)) - 1

    def light_of(self, image: NDArray[np.integer[Any]]) -> NDArray[np.float32]:
        """Light (...) [1] of an image's counts, which are at most the camera's largest."""
        most = self.most(image.dtype)
        levels = self.law(image.dtype).light(np.arange(most + 1) / most)
        return np.asarray(levels.astype(np.float32)[image])

    def light_of_difference(
        self, counts: ArrayLike, depth: DTypeLike = np.uint8, largest: float | None = None
    ) -> Array:
        """Light (...) [1] of a spot whose background was subtracted in counts, such as PAINT's
        ``flux``.

        ``counts`` (...) above the sheet may have any unit. Such an image is stretched, so its
        brightest position has `peak_counts`. ``largest`` is the count at that position, by default
        the maximum of ``counts``.
        """
        law, share = self.law(depth), np.asarray(counts, dtype=np.float64)
        largest = float(share.max(initial=0)) if largest is None else largest
        over = (self.peak_counts - self.ambient) * share / max(largest, 1e-12)
        return law.light(self.ambient + over) - law.light(self.ambient)

    def counts_of_difference(self, light: ArrayLike, depth: DTypeLike = np.uint8) -> Array:
        """Counts (...) [1] above the sheet of a spot's ``light`` (...), which may have any unit.

        The inverse of `light_of_difference`: the brightest position has `peak_counts`.
        """
        law, share = self.law(depth), np.asarray(light, dtype=np.float64)
        sheet, peak = law.light((self.ambient, self.peak_counts))
        spot = (peak - sheet) * share / max(float(share.max(initial=0)), 1e-12)
        return law.counts(sheet + spot) - self.ambient


def camera_at(cameras: Sequence[Camera], target: str, taken_at: datetime | None) -> Camera | None:
    """The camera of a target at a time; None if none is declared.

    If several are possible, the latest one counts. A photograph of unknown time has the latest of
    all.
    """
    there = [
        camera
        for camera in cameras
        if (not camera.targets or target in camera.targets)
        and (camera.since is None or taken_at is None or camera.since <= taken_at)
    ]
    return max(there, key=lambda c: c.since.timestamp() if c.since else -np.inf, default=None)


def cameras_from_json(data: object) -> tuple[Camera, ...]:
    """Parse the cameras of ``twin.json``.

    The form is ``[{"transfer": "srgb", "ambient": 0.53, "since": TIME, "targets": [..]}]``.
    ``transfer`` is ``srgb``, ``linear``, ``{"gamma": 2.2}`` or ``{"counts": [..], "light": [..]}``.
    There are also ``bits`` and ``peak_counts``. Each key is optional.

    Raises
    ------
    InvalidInputError
        If one is malformed, or its curve does not increase.
    """
    if not isinstance(data, list):
        raise InvalidInputError("'cameras' must be a list of cameras")
    return tuple(_camera(entry) for entry in data)


def _camera(data: object) -> Camera:
    known = {"transfer", "ambient", "peak_counts", "bits", "since", "targets"}
    if not isinstance(data, Mapping) or set(data) - known:
        raise InvalidInputError(
            f"a camera must be an object with {', '.join(sorted(known))}, got {str(data)[:80]}"
        )
    targets, bits = data.get("targets", []), data.get("bits")
    if not isinstance(targets, list) or not all(isinstance(name, str) for name in targets):
        raise InvalidInputError("a camera's 'targets' must be a list of names")
    if bits is not None and (isinstance(bits, bool) or not isinstance(bits, int)):
        raise InvalidInputError(f"a camera's 'bits' must be a whole number, got {str(bits)[:80]}")
    return Camera(
        transfer=_transfer(data["transfer"]) if "transfer" in data else None,
        ambient=_number(data, "ambient", USUAL_AMBIENT),
        since=_moment(data.get("since")),
        targets=tuple(targets),
        peak_counts=_number(data, "peak_counts", 1.0),
        bits=bits,
    )


def _number(data: Mapping[str, object], key: str, usual: float) -> float:
    value = data.get(key, usual)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InvalidInputError(f"a camera's '{key}' must be a number, got {str(value)[:80]}")
    return float(value)


def _moment(since: object) -> datetime | None:
    try:
        moment = None if since is None else datetime.fromisoformat(str(since))
    except ValueError:
        moment = datetime.min
    if moment is not None and moment.tzinfo is None:
        raise InvalidInputError(
            f"a camera's 'since' must be an ISO 8601 time with its zone, got {str(since)[:80]}"
        )
    return moment


def _transfer(data: object) -> Transfer:
    if data in ("srgb", "linear"):
        return Srgb() if data == "srgb" else LINEAR
    if isinstance(data, Mapping) and set(data) in ({"gamma"}, {"counts", "light"}):
        try:
            numbers = {key: np.asarray(value, dtype=np.float64) for key, value in data.items()}
        except (TypeError, ValueError):
            raise InvalidInputError(
                f"a camera's 'transfer' must hold numbers, got {str(data)[:80]}"
            ) from None
        if any(values.ndim != (key != "gamma") for key, values in numbers.items()):
            raise InvalidInputError(
                "a camera's 'gamma' is one number, 'counts' and 'light' are lists, got"
                f" {str(data)[:80]}"
            )
        if "gamma" in numbers:
            return Power(float(numbers["gamma"]))
        return Measured(tuple(numbers["counts"].tolist()), tuple(numbers["light"].tolist()))
    raise InvalidInputError(
        'a camera\'s \'transfer\' must be "srgb", "linear", {"gamma": ..} or {"counts": [..],'
        f' "light": [..]}}, got {str(data)[:80]}'
    )
