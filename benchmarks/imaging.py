"""The photograph pipeline on real images: ``python -m benchmarks.imaging [--out DIR]``.

Every AA23 set is measured from its raw frame and from PAINT's crop, and compared with what PAINT
published: the crop (normalised cross-correlation), the flux (accuracy 1 - sum|a - b| / sum, equal
sums) and the focal spot (distance of the centres of mass). The data are read from ``HELIOTWIN_STJ``
(default ``../shared/stj``).
"""

import argparse
import json
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import cv2
import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray

from benchmarks import data_folder
from benchmarks.record import Estimate, log_row, recording
from model.imaging import Camera, MeasuredFlux, center_of_mass, measure
from model.imaging.light import LINEAR, Srgb
from model.plant import Plant, TargetPlane
from service.sources.decode import Pixels, decode_image
from service.sources.documents import read_json, read_targets, read_tower_base
from service.sources.photograph import mark_layouts

TOWER = "WRI1030197-tower-measurements.json"
Flux = NDArray[np.floating]


@dataclass(frozen=True, eq=False)
class Case:
    """One calibration set: PAINT's images and focal spot, and what was measured from the raw frame
    and the crop.
    """

    name: str
    target: str
    raw: Pixels | None
    paint_crop: Pixels
    paint_flux: NDArray[np.float64]
    focal_spot: NDArray[np.float64]
    from_raw: MeasuredFlux | None
    from_crop: MeasuredFlux
    seconds: float

    @property
    def best(self) -> MeasuredFlux:
        return self.from_raw or self.from_crop


def read_plant(folder: Path) -> Plant:
    """The tower and its targets, from PAINT's tower measurements."""
    tower = read_json(folder / TOWER)
    return Plant("stj", read_tower_base(tower), read_targets(tower))


def read_case(properties: Path, plant: Plant) -> Case:
    """A calibration set, measured."""
    stem = properties.name.removesuffix("-calibration-properties.json")
    record = json.loads(properties.read_text())
    plane = plant.targets[record["target_name"]]

    def image(kind: str) -> Pixels:
        return decode_image((properties.parent / f"{stem}-{kind}.png").read_bytes())

    raw = image("raw") if (properties.parent / f"{stem}-raw.png").exists() else None
    start = perf_counter()
    linear = Camera(LINEAR)  # PAINT's fluxes are differences of counts
    from_raw = (
        None
        if raw is None
        else measure(raw, "raw", plane, layouts=mark_layouts(plane.name), camera=linear)
    )
    return Case(
        name=stem,
        target=plane.name,
        raw=raw,
        paint_crop=image("cropped"),
        paint_flux=image("flux").astype(np.float64),
        focal_spot=plane.to_plane(plant.to_enu(record["focal_spot"]["UTIS"])),
        from_raw=from_raw,
        from_crop=measure(image("cropped"), "cropped", plane, camera=linear),
        seconds=perf_counter() - start,
    )


def correlation(ours: Pixels, theirs: Pixels) -> float:
    return float(np.corrcoef(ours.ravel().astype(float), theirs.ravel().astype(float))[0, 1])


def accuracy(ours: NDArray[np.floating] | None, theirs: NDArray[np.floating]) -> float:
    if ours is None:
        return float("nan")
    return 1 - float(np.abs(ours / ours.sum(dtype=float) - theirs / theirs.sum(dtype=float)).sum())


def offset(measured: MeasuredFlux, case: Case) -> float:
    if measured.center_of_mass is None:
        return float("nan")
    return float(np.linalg.norm(measured.center_of_mass - case.focal_spot))


def figures(case: Case) -> dict[str, float]:
    """All figures of a set; NaN where it has no raw frame."""
    raw = case.from_raw
    missing = float("nan")
    crop = None if raw is None else raw.crop
    return {
        "crop NCC": missing if crop is None else correlation(crop, case.paint_crop),
        "flux raw": missing if raw is None else accuracy(raw.flux, case.paint_flux),
        "flux crop": accuracy(case.from_crop.flux, case.paint_flux),
        "CoM raw": missing if raw is None else offset(raw, case),
        "CoM crop": offset(case.from_crop, case),
        "paint dx": missing if crop is None else mark_shift(case),
        "seconds": case.seconds,
    }


FIGURES: dict[str, tuple[str, Callable[[Any], Any], tuple[str | None, str | None]]] = {
    "crop NCC": ("crop from the frame, correlation", np.nanmin, (None, ">= 0.97")),
    "flux raw": ("flux from the frame, accuracy", np.nanmin, (">= 0.85", None)),
    "flux crop": ("flux from PAINT's crop, accuracy", np.nanmin, (">= 0.85", None)),
    "CoM raw": ("centre of mass from the frame [m]", np.nanmax, ("<= 0.1", None)),
    "CoM crop": ("centre of mass from PAINT's crop [m]", np.nanmax, ("<= 0.1", None)),
}
"""Of each column that is recorded: its name, which value is the worst, and the goals of median and
worst.
"""


def mark_shift(case: Case) -> float:
    """How far PAINT's crop lies from ours [crop px], the largest of its corners, by registering one
    onto the other.
    """
    assert case.from_raw is not None
    assert case.from_raw.crop is not None
    _, warp = cv2.findTransformECC(
        case.from_raw.crop,
        case.paint_crop,
        np.eye(3, dtype=np.float32),
        cv2.MOTION_HOMOGRAPHY,
        (3, 300, 1e-6),
    )
    square = np.array([[[-0.5, -0.5], [255.5, -0.5], [-0.5, 255.5], [255.5, 255.5]]])
    moved = cv2.perspectiveTransform(square, np.linalg.inv(warp.astype(np.float64)))
    return float(np.linalg.norm(moved - square, axis=-1).max())


def print_table(cases: list[Case]) -> None:
    rows = {case.name: figures(case) for case in cases}
    names = list(next(iter(rows.values())))
    print(
        f"{'AA23 set':>10} {'target':28}" + "".join(f"{name:>11}" for name in names) + "  refused"
    )
    for case in cases:
        reasons = {m.quality.reason for m in (case.from_raw, case.from_crop) if m is not None} - {
            None
        }
        values = "".join(f"{value:11.3f}" for value in rows[case.name].values())
        print(
            f"{case.name:>10} {case.target:28}{values} "
            f" {', '.join(sorted(map(str, reasons))) or '-'}"
        )
    columns = {name: np.array([row[name] for row in rows.values()]) for name in names}
    medians = "".join(f"{np.nanmedian(column):11.3f}" for column in columns.values())
    print(f"{'median':>10} {'':28}{medians}")
    for name, (label, worst, goals) in FIGURES.items():
        log_row(
            "Photographs measured, against PAINT",
            label,
            {
                "median": Estimate(np.nanmedian(columns[name]), goal=goals[0]),
                "worst": Estimate(worst(columns[name]), goal=goals[1]),
            },
            n=int(np.isfinite(columns[name]).sum()),
            of="photographs",
            compared_with="what PAINT published",
        )
    print("goals: crop NCC >= 0.97, flux >= 0.85 (median), CoM <= 0.10 m (median)")
    print(
        "raw: from the camera frame; crop: from PAINT's crop (separation alone); paint dx: shift of"
        " PAINT's crop [px]"
    )


def contact_sheet(cases: list[Case], path: Path) -> None:
    """Raw frame, our crop, PAINT's crop, our flux, PAINT's flux of every set, the worst first."""
    mpl.use("Agg")
    from matplotlib import pyplot as plt

    order = sorted(
        cases, key=lambda case: np.nan_to_num(accuracy(case.best.flux, case.paint_flux), nan=-1.0)
    )
    fig, axes = plt.subplots(len(order), 5, figsize=(15, 3 * len(order)), squeeze=False)
    for row, case in zip(axes, order, strict=True):
        kind = "raw" if case.from_raw else "crop"
        score = accuracy(case.best.flux, case.paint_flux)
        for axis, (title, picture) in zip(row, pictures(case).items(), strict=True):
            axis.set_title(title, fontsize=8)
            axis.axis("off")
            if picture is not None:
                axis.imshow(picture, cmap="gray" if "crop" in title else "inferno")
        row[0].set_title(f"{case.name} {case.target}, flux from {kind} {score:.3f}", fontsize=8)
    fig.tight_layout()
    fig.savefig(path, dpi=70)
    plt.close(fig)


def pictures(case: Case) -> dict[str, NDArray[np.generic] | None]:
    raw = (
        None
        if case.raw is None
        else cv2.resize(case.raw, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
    )
    if raw is not None and case.best.corners is not None:
        ring = np.round(case.best.corners[[0, 1, 3, 2]] / 4).astype(np.int32)
        cv2.polylines(raw, [ring], True, (255, 0, 0), 2)
    return {
        "raw": raw,
        "our crop": None if case.from_raw is None else case.from_raw.crop,
        "PAINT crop": case.paint_crop,
        "our flux": case.best.flux,
        "PAINT flux": case.paint_flux,
    }


def measure_folder(folder: Path, plane: TargetPlane) -> Counter[str]:
    """How often each verdict falls on the crops of a folder."""
    paths = sorted(folder.glob("*.png"))
    return Counter(
        measure(decode_image(path.read_bytes()), "cropped", plane).quality.reason or "accepted"
        for path in paths
    )


def composite(
    rng: np.random.Generator, empties: list[Path], fluxes: list[Path], *, foreign: bool
) -> tuple[NDArray[np.uint8], Flux]:
    """A real empty target with a real flux somewhere on it, beside a foreign spot of half the size;
    and that flux.

    Light is added to light, and encoded as the camera does it.
    """
    empty = Srgb().light(decode_image(empties[rng.integers(len(empties))].read_bytes()) / 255)
    reflectance = empty / np.median(empty)

    def placed(scale: float) -> Flux:
        whole = decode_image(fluxes[rng.integers(len(fluxes))].read_bytes()).astype(np.float32)
        flux = cv2.warpAffine(whole, np.array([[scale, 0, 0], [0, scale, 0]]), (256, 256))
        rows, columns = np.nonzero(flux > 0.02 * flux.max())
        shift = (
            rng.integers(-columns.min(), 256 - columns.max()),
            rng.integers(-rows.min(), 256 - rows.max()),
        )
        moved = cv2.warpAffine(flux, np.array([[1.0, 0, shift[0]], [0, 1, shift[1]]]), (256, 256))
        return np.asarray(moved / flux.max(), dtype=np.float32)

    spot, other = placed(1.0), np.zeros((256, 256), np.float32)
    while foreign and (not other.any() or np.minimum(spot, other).sum() > 0.02 * spot.sum()):
        spot, other = placed(1.0), placed(0.5) * np.float32(rng.uniform(0.3, 1.0))
    light = empty + reflectance * rng.uniform(0.3, 0.7) * (spot + other)
    counts = 255 * Srgb().counts(light) + rng.normal(0, 1, empty.shape)
    return np.clip(counts, 0, 255).astype(np.uint8), spot


def composites(folder: Path, plane: TargetPlane, count: int, *, foreign: bool) -> str:
    """Separation where the truth is known: real fluxes on real empty targets."""
    empties = sorted((folder / "empty-targets").glob("*.png"))
    fluxes = sorted(folder.glob("*/Calibration/*-flux.png"))
    if not empties or not fluxes:
        return "no data"
    rng, rows = np.random.default_rng(0), []
    refusals: Counter[str] = Counter()
    for _ in range(count):
        crop, truth = composite(rng, empties, fluxes, foreign=foreign)
        result = measure(crop, "cropped", plane)
        if result.flux is None or result.center_of_mass is None:
            refusals[str(result.quality.reason)] += 1
            continue
        miss = result.center_of_mass - center_of_mass(truth, (plane.width, plane.height))
        rows.append((accuracy(result.flux, truth), float(np.linalg.norm(miss))))
    score, miss = np.array(rows).T
    log_row(
        "Real fluxes on real empty targets",
        "with a foreign spot" if foreign else "alone",
        {
            "accuracy, median": np.median(score),
            "accuracy, 5 % below": np.percentile(score, 5),
            "centre of mass, median [m]": np.median(miss),
            "centre of mass, 95 % within [m]": np.percentile(miss, 95),
        },
        n=len(rows),
        of="images",
        compared_with="the fluxes laid on",
    )
    return (
        f"accuracy median {np.median(score):.3f}, 5 % below {np.percentile(score, 5):.3f}; centre"
        f" of mass median {np.median(miss):.3f} m, 95 % within {np.percentile(miss, 95):.3f} m;"
        f" refused {dict(refusals) or 'none'}"
    )


def main(argv: list[str] | None = None) -> int:
    """Print the figures and write the contact sheet."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("out/imaging"))
    parser.add_argument(
        "--composites", type=int, default=150, help="how many are made of fluxes and empty targets"
    )
    options = parser.parse_args(argv)
    folder = data_folder()
    if not (folder / TOWER).exists():
        print(
            f"no data in {folder}: set HELIOTWIN_STJ to the folder of real measurements; nothing"
            " was measured"
        )
        return 0
    plant = read_plant(folder)
    cases = [
        read_case(path, plant)
        for path in sorted((folder / "AA23/Calibration").glob("*-properties.json"))
    ]
    print_table(cases)
    options.out.mkdir(parents=True, exist_ok=True)
    contact_sheet(cases, options.out / "aa23.png")
    print(f"contact sheet, worst first: {options.out / 'aa23.png'}")
    lower = plant.targets["solar_tower_juelich_lower"]
    for name in ("target-samples", "empty-targets"):
        verdicts = measure_folder(folder / name, lower)
        total = sum(verdicts.values())
        print(
            f"{name}: "
            + ", ".join(f"{reason} {count}/{total}" for reason, count in verdicts.most_common())
        )
        accepted = {"accepted": verdicts["accepted"]}
        log_row("Verdicts on folders of crops", name, accepted, n=total, of="crops")
    for foreign in (False, True):
        label = "real fluxes on real empty targets" + (", a foreign spot beside" if foreign else "")
        print(
            f"{label} ({options.composites}):"
            f" {composites(folder, lower, options.composites, foreign=foreign)}"
        )
    return 0


if __name__ == "__main__":
    with recording("imaging"):
        status = main()
    raise SystemExit(status)
