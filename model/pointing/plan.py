"""Which photograph would tell most of a mount: the information that a spot is expected to bring.

A spot measured with noise R, where the mount foretells it with covariance S + R, tells half the logarithm of
det(S + R) / det(R): much where the mount is unsure, nothing where it knows. Source: Lindley 1956,
doi:10.1214/aoms/1177728069.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.errors import ModelError
from model.plant import Heliostat, TargetPlane
from model.pointing.mounts import CalibratedMount

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


def propose(
    heliostat: Heliostat, mount: CalibratedMount, plane: TargetPlane, sun: ArrayLike, day: float, slot: int = 0
) -> Proposal:
    """What a photograph of a heliostat would tell; raises what `CalibratedMount.motors` raises."""
    source = np.asarray(sun, dtype=np.float64)
    motors = mount.motors(heliostat, source, plane.center, day)
    cov = mount.covariance_at(heliostat, motors[None], source[None], plane.center[None], np.array([day]))[0]
    bits = 0.5 * (np.log2(np.linalg.det(cov)) - 4 * np.log2(mount.noise.spot_rad))
    std = 1e3 * float(np.sqrt(np.trace(cov) / 2))
    return Proposal(heliostat.name, plane.name, slot, motors, max(0.0, float(bits)), std)


def plan(
    heliostats: Mapping[str, Heliostat],
    mounts: Mapping[str, CalibratedMount],
    planes: Sequence[TargetPlane],
    suns: Sequence[Array],
    days: Sequence[float],
) -> list[Proposal]:
    """One photograph for each of the ``suns`` (3,), at ``days`` [d]: each of the heliostat that it tells most of.

    A heliostat is proposed once. All are looked at under the middle sun on the first of ``planes`` they reach; those
    that promise most, some for each sun, on every plane and under every sun.
    """
    middle = len(suns) // 2
    first = [_best(heliostats[name], mounts[name], planes, suns, days, [middle], True) for name in mounts]
    promising = sorted((one for one in first if one is not None), key=lambda one: -one.information_bits)
    chosen: list[Proposal] = []
    left = [one.heliostat for one in promising[: 2 * len(suns)]]
    for slot in range(len(suns)):
        offers = [_best(heliostats[name], mounts[name], planes, suns, days, [slot], False) for name in left]
        best = max((one for one in offers if one is not None), key=lambda one: one.information_bits, default=None)
        if best is not None:
            chosen.append(best)
            left.remove(best.heliostat)
    return chosen


def best_sun(
    heliostat: Heliostat,
    mount: CalibratedMount,
    planes: Sequence[TargetPlane],
    suns: Sequence[Array],
    days: Sequence[float],
) -> Proposal | None:
    """The photograph that tells most of one heliostat, each sun's on the first of ``planes`` in reach; None without."""
    found = [_best(heliostat, mount, planes, suns, days, [slot], True) for slot in range(len(suns))]
    return max((one for one in found if one is not None), key=lambda one: one.information_bits, default=None)


def _best(
    heliostat: Heliostat,
    mount: CalibratedMount,
    planes: Sequence[TargetPlane],
    suns: Sequence[Array],
    days: Sequence[float],
    slots: Sequence[int],
    any_plane: bool,
) -> Proposal | None:
    """The proposal that tells most of one heliostat, or, for ``any_plane``, the first; None where none is in reach."""
    found = []
    for slot in slots:
        for plane in planes:
            try:
                found.append(propose(heliostat, mount, plane, suns[slot], days[slot], slot))
            except ModelError:  # beyond the drives' travel, or behind the mirror
                continue
            if any_plane:
                return found[0]
    return max(found, key=lambda one: one.information_bits, default=None)
