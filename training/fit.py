"""Fit control heights to deflectometry: ``python -m training.fit DIR [--out surfaces.npz]``.

Deflectometry measures the normal at thousands of points of each facet. The tracer's spline surface
is fitted to them. The table reports the residual angles, as in the paper (Lewen et al. 2024). It
also reports the loss in flux accuracy of the 8 x 8 heights, compared with a finer surface that was
fitted to the same normals.

DIR is in PAINT's layout: ``H/Properties/H-heliostat-properties.json``, and ``H/Deflectometry`` with
PAINT's ``*deflectometry.h5`` (points and normals of each facet) or ``H-nurbs-surface.npz``
(``points``, ``normals``, and the finer surface's ``control_points``).
"""

import argparse
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from model.forecast import View, align
from model.frames import wgs84_to_enu
from model.images import FLUX_SHAPE, FLUX_WINDOW
from model.metrics import flux_accuracies
from model.mount import Mount
from model.plant import Facet, Heliostat
from model.plant_model import JUELICH_MODEL
from model.setup import Setup
from model.surface import COLUMNS, DEGREE, ROWS, basis, control_points, fit_heights, halved, heights
from training.cases import SOURCE
from training.figures import markdown, shown
from training.render import SceneSampler

Array = NDArray[np.float64]

SUNS = 8
"""Suns over the year for the flux accuracy."""


@dataclass(frozen=True, eq=False)
class Deflectometry:
    """Measured normals of one mirror.

    Attributes
    ----------
    heliostat : Heliostat
    points, normals : list of (n, 3) [m], [1]
        For each facet, in mirror coordinates; normals are unit vectors.
    fine : (F, I, J, 3) [m], optional
        Control points of a finer surface of degree three that was fitted to the same normals.
    """

    heliostat: Heliostat
    points: list[Array]
    normals: list[Array]
    fine: Array | None = None


def read_heliostat(root: Path, name: str) -> Heliostat:
    """Read a heliostat's position and its ideal facets."""
    tower = json.loads(next(root.glob("*tower-measurements.json")).read_text(encoding="utf-8"))
    path = root / name / "Properties" / f"{name}-heliostat-properties.json"
    properties = json.loads(path.read_text(encoding="utf-8"))

    def vector(values: Any) -> Array:
        return np.asarray(values, dtype=np.float64)

    return Heliostat(
        name=name,
        position=wgs84_to_enu(
            vector(properties["heliostat_position"]),
            vector(tower["power_plant_properties"]["coordinates"]),
        ),
        mount=Mount.juelich(),
        facets=tuple(
            Facet(vector(f["translation_vector"]), vector(f["canting_e"]), vector(f["canting_n"]))
            for f in properties["facet_properties"]["facets"]
        ),
    )


def read_deflectometry(root: Path, name: str) -> Deflectometry | None:
    """Read the deflectometry of a heliostat's mirror; None if there is none."""
    folder = root / name / "Deflectometry"
    for file in sorted(folder.glob("*deflectometry.h5")):
        heliostat = read_heliostat(root, name)
        with h5py.File(file, "r") as data:
            facets = [data[f"facet{number}"] for number in range(1, len(heliostat.facets) + 1)]
            points, normals = (
                [_rows(f[key]) for f in facets] for key in ("surface_points", "surface_normals")
            )
        return Deflectometry(heliostat, points, normals)
    for file in folder.glob(f"{name}-nurbs-surface.npz"):
        with np.load(file) as data:
            points, normals = (
                [_rows(facet) for facet in data[key]] for key in ("points", "normals")
            )
            fine = data["control_points"].astype(np.float64)
        return Deflectometry(read_heliostat(root, name), points, normals, fine)
    return None


def _rows(vectors: Any) -> Array:
    """Vectors (..., 3) as (n, 3)."""
    return np.asarray(vectors, dtype=np.float64).reshape(-1, 3)


@dataclass(frozen=True, eq=False)
class MirrorFit:
    """Heights (F, 8, 8) [m] of a mirror, and residual angles (n,) [mrad] of its normals."""

    z: Array
    residuals_mrad: Array


def fit(measured: Deflectometry) -> MirrorFit:
    """Fit every facet by least squares."""
    centers, axes, half_sizes = measured.heliostat.facet_frames
    facets = [
        fit_facet((points - center) @ frame.T, normals @ frame.T, half_size)
        for points, normals, center, frame, half_size in zip(
            measured.points, measured.normals, centers, axes, half_sizes, strict=True
        )
    ]
    return MirrorFit(
        np.array([f.z for f in facets]), np.concatenate([f.residuals_mrad for f in facets])
    )


def fit_facet(points: Array, normals: Array, half_size: Array) -> MirrorFit:
    """Fit one facet to points (n, 3) [m] and normals (n, 3) in its ideal frame.

    Points beyond its edges are not used.
    """
    u, v = (points[:, :2] / (2 * half_size) + 0.5).T
    there = (u >= 0) & (u <= 1) & (v >= 0) & (v <= 1) & np.isfinite(normals).all(axis=1)
    u, v = u[there], v[there]
    normals = normals[there] / np.linalg.norm(normals[there], axis=1, keepdims=True)
    z = fit_heights(u, v, normals, half_size)
    apart = np.linalg.norm(normals_of(z, u, v, half_size) - normals, axis=1)
    return MirrorFit(z, 2e3 * np.arcsin(apart / 2))


def normals_of(z: Array, u: Array, v: Array, half_size: Array) -> Array:
    """Unit normals (n, 3) of heights (8, 8) [m] in a facet's frame.

    ``u`` and ``v`` (n,) are positions on the facet, from 0 to 1.
    """
    (value_u, slope_u), (value_v, slope_v) = basis(ROWS, DEGREE, u), basis(COLUMNS, DEGREE, v)
    along_x = np.einsum("ni,ij,nj->n", slope_u, z, value_v, optimize=True) / (2 * half_size[0])
    along_y = np.einsum("ni,ij,nj->n", value_u, z, slope_v, optimize=True) / (2 * half_size[1])
    normals = np.stack([-along_x, -along_y, np.ones_like(u)], axis=1)
    return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))


def fit_accuracies(heliostat: Heliostat, fine: Array, coarse: Array, seed: int = 0) -> Array:
    """Flux accuracy (`SUNS`,) of a coarse surface compared with a fine one.

    Both are control points (F, I, J, 3) [m].
    """
    suns = SceneSampler().suns(SUNS, np.random.default_rng(seed))
    view = View(*FLUX_SHAPE, window=FLUX_WINDOW, samples=64, cones="facet")
    truth, fitted = (
        align(
            [Setup(heliostat, points, sun, SOURCE, spot=SOURCE.center) for sun in suns],
            JUELICH_MODEL,
        )
        .images(view)
        .clamp(min=0)
        .numpy()
        for points in (fine, coarse)
    )
    return flux_accuracies(truth, fitted)


HEAD = (
    "mirror",
    "normals",
    "below 0.1 mrad",
    "rms [mrad]",
    "99 % below [mrad]",
    "largest [mrad]",
    "flux accuracy lost",
    "ripples, rms [mm]",
)


def row(measured: Deflectometry, fitted: MirrorFit) -> list[str]:
    """A mirror's row of the table.

    Without a finer surface, the loss of accuracy and the ripples are empty.
    """
    residuals, loss, ripples = fitted.residuals_mrad, None, None
    if measured.fine is not None:
        coarse = control_points(measured.heliostat, fitted.z)
        loss = 1 - float(fit_accuracies(measured.heliostat, measured.fine, coarse).mean())
        same = halved(fitted.z)
        ripples = 1e3 * np.std(
            heights(measured.heliostat, measured.fine, shape=same.shape[1:]) - same
        )
    figures = (
        np.sqrt((residuals**2).mean()),
        np.quantile(residuals, 0.99),
        residuals.max(),
        loss,
        ripples,
    )
    return [
        measured.heliostat.name,
        str(len(residuals)),
        f"{(residuals < 0.1).mean():.1%}",
        *(shown(None if f is None else float(f)) for f in figures),
    ]


def main() -> None:
    """Fit every measured mirror of a folder, print the table, and write the heights.

    The heights are written only with ``--out``.
    """
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument(
        "--out", type=Path, help="surfaces.npz with names and heights, as training reads it"
    )
    arguments = parser.parse_args()
    found = {
        p.name: read_deflectometry(arguments.folder, p.name)
        for p in sorted(arguments.folder.iterdir())
    }
    measured = {
        name: deflectometry for name, deflectometry in found.items() if deflectometry is not None
    }
    if not measured:
        raise SystemExit(f"{arguments.folder}: no 'H/Deflectometry' with normals in it")
    fits = {name: fit(deflectometry) for name, deflectometry in measured.items()}
    print(markdown(HEAD, [row(measured[name], fitted) for name, fitted in fits.items()]))
    if arguments.out:
        z = np.array([fitted.z for fitted in fits.values()], dtype=np.float32)
        np.savez_compressed(arguments.out, z=z, names=np.array(list(fits)))


if __name__ == "__main__":
    main()
