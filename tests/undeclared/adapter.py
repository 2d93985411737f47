"""A generated set as the product takes it: its own types, or a measurement folder in PAINT's
layout.

Of all modules of the generator only this one knows the product.
"""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from model.effects import Effect, effects_from_json
from model.frames import enu_to_wgs84, sun_angles
from model.mount import Mount
from model.plant import Facet, Heliostat, TargetPlane
from model.setup import Setup
from model.study import FluxImage
from model.surface import control_points, fit_heights
from service.sources.paint_documents import azimuth_from_south
from tests.undeclared import plant, sky
from tests.undeclared.generator import MeasurementSet
from tests.undeclared.plan import Plan

Array = NDArray[np.float64]

SAMPLES = 48
"""Along a facet, of the slopes to which the product's splines are fitted."""


def target_of(target: plant.Target) -> TargetPlane:
    """A target."""
    return TargetPlane(
        target.name, target.center, target.normal, target.up, target.width, target.height
    )


def heliostat_of(heliostat: plant.Heliostat) -> Heliostat:
    """A heliostat by its plans."""
    facets = tuple(Facet(facet.position, facet.along, facet.across) for facet in heliostat.facets)
    return Heliostat(heliostat.name, heliostat.position, Mount.juelich(), facets)


def surface_of(heliostat: plant.Heliostat) -> Array:
    """Control points (4, 8, 8, 3) [m]: what deflectometry would make of the mirror's slopes."""
    grid = (np.arange(SAMPLES) + 0.5) / SAMPLES
    u, v = (axis.ravel() for axis in np.meshgrid(grid, grid, indexing="ij"))
    heights = []
    for facet in heliostat.facets:
        _, by_x, by_y = facet.surface(2 * grid - 1, 2 * grid - 1)
        normals = np.column_stack([-by_x.ravel(), -by_y.ravel(), np.ones(len(u))])
        heights.append(fit_heights(u, v, normals, facet.half))
    return control_points(heliostat_of(heliostat), heights)


def effects_of(made: MeasurementSet) -> list[Effect]:
    """The truth as the model states it."""
    return effects_from_json(made.truth)


def setups_of(made: MeasurementSet) -> list[Setup]:
    """What is recorded, the spots where they were aimed at."""
    mirrors = {plan.heliostat.name: plan.heliostat for plan in made.plans}
    known = {name: (heliostat_of(mirror), surface_of(mirror)) for name, mirror in mirrors.items()}
    return [
        Setup(
            *known[plan.heliostat.name],
            plan.sun(),
            target_of(plan.target),
            plan.goal,
            identifier=f"{plan.heliostat.name}/{identifier}",
            temperature_c=15 + 8 * plan.warmth if world.row_focus else None,
        )
        for plan, world, identifier in zip(made.plans, made.worlds, made.identifiers, strict=True)
    ]


def flux_images(made: MeasurementSet, encoders: Sequence[Array] | None = None) -> list[FluxImage]:
    """Images of light alone, without times, and with what encoders said where that is given."""
    said = encoders or [None] * len(made.plans)
    setups = [
        replace(setup, angles=angles) for setup, angles in zip(setups_of(made), said, strict=True)
    ]
    return [FluxImage(setup, image) for setup, image in zip(setups, made.images, strict=True)]


# --- a folder
# --------------------------------------------------------------------------------------------------


def write_folder(made: MeasurementSet, root: Path) -> Path:
    """A measurement folder in PAINT's layout, with surfaces and times."""
    _write(
        root / "WRI0000001-tower-measurements.json",
        _tower({p.target.name: p.target for p in made.plans}),
    )
    _write(root / "twin.json", {"declared": {"sun": {"shape": "buie", "circumsolar_ratio": 0.02}}})
    for name, mirror in {plan.heliostat.name: plan.heliostat for plan in made.plans}.items():
        _write(
            root / name / "Properties" / f"{name}-heliostat-properties.json", _properties(mirror)
        )
        surface = root / name / "Deflectometry" / f"{name}-nurbs-surface.npz"
        surface.parent.mkdir(parents=True)
        np.savez_compressed(surface, control_points=surface_of(mirror))
    kind = "cropped" if made.on_sheet else "flux"
    for plan, identifier, image in zip(made.plans, made.identifiers, made.images, strict=True):
        base = root / plan.heliostat.name / "Calibration" / identifier
        _write(base.with_name(f"{identifier}-calibration-properties.json"), _measurement(plan))
        _write(
            base.with_name(f"{identifier}-calibration-item-stac.json"),
            {"properties": {"datetime": plan.moment.isoformat()}},
        )
        cv2.imwrite(str(base.with_name(f"{identifier}-{kind}.png")), image.astype(np.uint8))
    return root


def _write(path: Path, content: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content), encoding="utf-8")


def _wgs84(place: Array) -> list[float]:
    return enu_to_wgs84(place, sky.PLACE).tolist()


def _tower(targets: dict[str, plant.Target]) -> dict[str, Any]:
    """The contents of ``tower-measurements.json``."""
    tower: dict[str, Any] = {
        "power_plant_properties": {"ID": "WRI0000001", "coordinates": sky.PLACE.tolist()}
    }
    for name, target in targets.items():
        right, up, normal = target.axes
        corners = {
            f"{row}_{column}": _wgs84(
                target.center + (y * target.height * up + x * target.width * right) / 2
            )
            for row, y in (("upper", 1), ("lower", -1))
            for column, x in (("left", -1), ("right", 1))
        }
        tower[name] = {"type": "planar", "normal_vector": normal.tolist(), "coordinates": corners}
    return tower


def _properties(heliostat: plant.Heliostat) -> dict[str, Any]:
    """The contents of ``heliostat-properties.json``; nothing is known of its drives."""
    kinematics: dict[str, Any] = {
        f"joint_translation_{axis}_{stage}": 0.0 for axis in "enu" for stage in (1, 2)
    }
    kinematics |= {"concentrator_translation_n": 0.175, "actuators": []}
    facets = [
        {
            "translation_vector": facet.position.tolist(),
            "canting_e": facet.along.tolist(),
            "canting_n": facet.across.tolist(),
        }
        for facet in heliostat.facets
    ]
    return {
        "heliostat_position": _wgs84(heliostat.position),
        "width": heliostat.width,
        "height": heliostat.height,
        "kinematics_properties": kinematics,
        "facet_properties": {"facets": facets},
    }


def _measurement(plan: Plan) -> dict[str, Any]:
    """The contents of ``calibration-properties.json``; nothing is known of the motors."""
    azimuth, elevation = sun_angles(plan.sun())
    return {
        "target_name": plan.target.name,
        "sun_azimuth": azimuth_from_south(float(azimuth)),
        "sun_elevation": float(elevation),
        "focal_spot": {"UTIS": _wgs84(plan.goal)},
    }
