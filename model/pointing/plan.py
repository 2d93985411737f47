"""Find the photographs that are most informative about a mount, by expected information.

The mount predicts a spot with covariance S + R, where R is the measurement noise. The information
of that spot is half the logarithm of det(S + R) / det(R): high if the mount is uncertain, zero if
it is known. Source: Lindley 1956, doi:10.1214/aoms/1177728069.
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from model.errors import ModelError
from model.fleet import in_parts
from model.plant import Heliostat, TargetPlane
from model.pointing.mounts import CalibratedMount
from model.pointing.spots import find_motors, spot_covariance

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Proposal:
    """A photograph to take.

    Attributes
    ----------
    heliostat, target : str
    slot : int
        Which of the suns it is for.
    motors : (2,) [steps]
        What sends the light to the target's centre then.
    information_bits : float
    std_mrad : float [mrad]
        Of the spot, by what is known now; the root of the mean of both directions.
    """

    heliostat: str
    target: str
    slot: int
    motors: Array
    information_bits: float
    std_mrad: float


def plan(
    heliostats: Mapping[str, Heliostat],
    mounts: Mapping[str, CalibratedMount],
    planes: Sequence[TargetPlane],
    suns: Sequence[Array],
    days: Sequence[float],
    wanted: Collection[str] = (),
) -> list[Proposal]:
    """Propose the most informative photograph for each of the ``suns`` (3,), at ``days`` [d].

    A heliostat is proposed once at most, and those ``wanted`` before others. All heliostats are
    evaluated under the middle sun, on the first of ``planes`` that they reach. The most informative
    of them, two per sun, are evaluated on every plane and under every sun.
    """
    middle = len(suns) // 2
    first = [
        next(proposals(heliostats[name], mount, planes, suns, days, [middle]), None)
        for name, mount in mounts.items()
    ]
    promising = sorted(
        (one for one in first if one is not None),
        key=lambda one: (one.heliostat not in wanted, -one.information_bits),
    )
    names = [one.heliostat for one in promising[: 2 * len(suns)]]
    slots = range(len(suns))
    offers = [
        one
        for name in names
        for one in proposals(heliostats[name], mounts[name], planes, suns, days, slots)
    ]
    chosen: dict[str, Proposal] = {}
    for slot in slots:
        left = [one for one in offers if one.slot == slot and one.heliostat not in chosen]
        best = max(
            left, key=lambda one: (one.heliostat in wanted, one.information_bits), default=None
        )
        if best is not None:
            chosen[best.heliostat] = best
    return list(chosen.values())


def best_sun(
    heliostat: Heliostat,
    mount: CalibratedMount,
    planes: Sequence[TargetPlane],
    suns: Sequence[Array],
    days: Sequence[float],
) -> Proposal | None:
    """The most informative photograph of one heliostat; None if no plane is in reach.

    Each sun is evaluated on the first of ``planes`` that the heliostat reaches.
    """
    found = proposals(heliostat, mount, planes, suns, days, range(len(suns)))
    first = [next(on_planes) for _, on_planes in groupby(found, key=lambda one: one.slot)]
    return max(first, key=lambda one: one.information_bits, default=None)


def proposals(
    heliostat: Heliostat,
    mount: CalibratedMount,
    planes: Sequence[TargetPlane],
    suns: Sequence[Array],
    days: Sequence[float],
    slots: Sequence[int],
) -> Iterator[Proposal]:
    """Photographs of one heliostat under the suns of ``slots``, on each of ``planes``, in that
    order.

    Those beyond the drives' travel, or behind the mirror, are left out.
    """
    pairs = [(slot, plane) for slot in slots for plane in planes]
    if not pairs:
        return
    by_slot = dict(enumerate(suns)), dict(enumerate(days))
    for _, made in in_parts(lambda part: _propose_all(heliostat, mount, part, *by_slot), pairs):
        if not isinstance(made, ModelError):
            yield from made


def _propose_all(
    heliostat: Heliostat,
    mount: CalibratedMount,
    pairs: Sequence[tuple[int, TargetPlane]],
    suns: Mapping[int, Array],
    days: Mapping[int, float],
) -> list[Proposal]:
    """Expected information for each pair of a slot and a plane; raises if one is out of reach."""
    sun, day = (
        np.array([suns[slot] for slot, _ in pairs]),
        np.array([days[slot] for slot, _ in pairs]),
    )
    centers = np.array([plane.center for _, plane in pairs])
    motors = find_motors(mount, heliostat, sun, centers, day)
    cov = spot_covariance(mount, heliostat, motors, sun, centers, day)
    bits = np.maximum(0.5 * (np.log2(np.linalg.det(cov)) - 4 * np.log2(mount.noise.spot_rad)), 0.0)
    std = 1e3 * np.sqrt(np.trace(cov, axis1=1, axis2=2) / 2)
    return [
        Proposal(heliostat.name, plane.name, slot, motors[row], float(bits[row]), float(std[row]))
        for row, (slot, plane) in enumerate(pairs)
    ]
