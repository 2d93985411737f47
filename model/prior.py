"""What mirrors are like before any image is seen: a distribution over surfaces, estimated from measured ones.

Its directions come in groups: canting, focus, waviness from large to fine. Mirrors differ in how much they have of
each, some many times the others: each group has a scale of its own, which each mirror tells. A Gaussian whose variance
has an inverse gamma distribution is Student's t; that predicts mirrors left out far better than one Gaussian for all
(``python -m training.prior --compare``).

Refinement starts from it and is held to it, the network's first guess is its mean, and a predicted surface that lies
far from it is no mirror of the kind that is known.
"""

import hashlib
import io
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LEADING = 8
"""Directions of the prior in which Mahalanobis distances are taken: the longest, which every image shows."""

GROUPS = (0, 4, 8, 24, 64, 128)
"""First directions of the groups that have a scale each."""

FREEDOM = 3.0
"""Degrees of freedom of the scales: as much is known of them before a mirror is seen as so many coefficients tell."""

PRIOR = Path(__file__).parent / "weights" / "surface-prior.npz"


@dataclass(frozen=True, eq=False)
class SurfacePrior:
    """A distribution over surfaces, Gaussian but for the scales of its `GROUPS`.

    Attributes
    ----------
    mean : (4, 8, 8) [m]
    basis : (K, 4, 8, 8) [m]
        Orthogonal directions, each as long as its standard deviation; the longest first.
    hidden : (H, 4, 8, 8) [m]
        Directions that no image shows, as long as their standard deviations: the tilts of the whole mirror.
    name : str
        Which file, with its content hash.
    """

    mean: Array
    basis: Array
    hidden: Array
    name: str = "unnamed"

    @classmethod
    def load(cls, path: Path = PRIOR) -> "SurfacePrior":
        """Read a prior that `training.prior` wrote."""
        content = path.read_bytes()
        with np.load(io.BytesIO(content)) as data:
            name = f"{path.stem}-{hashlib.sha256(content).hexdigest()[:12]}"
            mean, basis, hidden = (data[key].astype(np.float64) for key in ("mean", "basis", "hidden"))
            return cls(mean, basis, hidden, name)

    def coefficients(self, z: Array) -> Array:
        """Coefficients (K,) of the surface of the prior's span nearest to ``z`` (4, 8, 8) [m]."""
        flat = self.basis.reshape(len(self.basis), -1)
        return np.asarray(flat @ (z - self.mean).ravel() / (flat**2).sum(axis=1))

    def surface(self, coefficients: Array) -> Array:
        """Heights (4, 8, 8) [m] of coefficients (K,)."""
        return np.asarray(self.mean + np.tensordot(coefficients, self.basis, axes=1))

    def precision(self, coefficients: Array, variance: Array) -> Array:
        """Precision (K,) of each coefficient, its group's, where coefficients (K,) are known up to a variance (K,).

        The mean of the scale's posterior, as expectation-maximisation has it for Student's t (Lange, Little and Taylor
        1989, doi:10.1080/01621459.1989.10478852).
        """
        starts = [start for start in GROUPS if start < len(coefficients)]
        counts = np.diff([*starts, len(coefficients)])
        found = np.add.reduceat(coefficients**2 + variance, starts)
        return np.repeat((FREEDOM + counts) / (FREEDOM + found), counts)

    def mahalanobis(self, z: Array) -> float:
        """Mahalanobis distance of ``z`` (4, 8, 8) [m] from the mean, over the root of its `LEADING` degrees of freedom.

        The root mean square of its leading coefficients; about one for a mirror of the kind that the prior was
        estimated from.
        """
        return float(np.sqrt((self.coefficients(z)[:LEADING] ** 2).mean()))

    def deviation(self, covariance: Array) -> Array:
        """Standard deviation (4, 8, 8) [m] of heights whose coefficients have a covariance (K, K)."""
        shown = np.einsum("kfij,kl,lfij->fij", self.basis, covariance, self.basis, optimize=True)
        return np.asarray(np.sqrt(shown + (self.hidden**2).sum(axis=0)))


@lru_cache(maxsize=1)
def default_prior() -> SurfacePrior:
    """The shipped prior, loaded once."""
    return SurfacePrior.load()
