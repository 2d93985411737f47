"""What was understood of a plant's file, as ``heliotwin plant check`` reports it."""

import numpy as np
from rich.table import Table

from heliotwin.cli.output import make_table
from model.locating import BracketMarks, CameraCorners, CameraHomography, CameraPose, SheetEdges
from model.plant import Cylinder, TargetPlane
from model.receivers import Cavity, Panels
from service.base.validation import counted
from service.sources.documents import describe_sun
from service.sources.plant_file import PlantDescription
from service.sources.plant_parts import AnyReceiver

Report = dict[str, object]

_KINDS = {Cylinder: "cylinder", TargetPlane: "plane", Panels: "panels", Cavity: "cavity"}

_LOCATED_BY: dict[type, str] = {
    BracketMarks: "marks",
    SheetEdges: "edges",
    CameraHomography: "camera",
    CameraCorners: "camera",
    CameraPose: "camera",
}


def plant_report(described: PlantDescription) -> Report:
    """Counts, areas and assumptions of a plant, as JSON has them."""
    plant, site = described.plant, described.plant.site
    return {
        "plant": plant.name,
        "origin": list(site.origin),
        "time_zone": described.time_zone,
        "heliostats": len(plant.heliostats),
        "mirror_area_m2": round(sum(h.area for h in plant.heliostats.values()), 3),
        "types": _types(described),
        "receivers": {
            name: _surface(receiver, described) for name, receiver in described.receivers.items()
        },
        "targets": {
            name: {
                **_surface(target, described),
                "marks": described.marks_of[name],
                "located_by": _LOCATED_BY[type(target.locator)],
            }
            for name, target in plant.targets.items()
        },
        "tower": None
        if described.tower is None
        else {"radius_m": described.tower.radius, "height_m": described.tower.height},
        "sun": describe_sun(described.optics.sun_shape),
        "attenuation": list(described.optics.attenuation),
        "assumed": list(described.assumed),
        "warnings": list(described.warnings),
    }


def _types(described: PlantDescription) -> Report:
    types: Report = {}
    for name, kind in described.types.items():
        (width, height), mirrors = kind.size, described.plant.heliostats
        areas = [mirrors[one].area for one, of in described.type_of.items() if of == name]
        types[name] = {
            "heliostats": len(areas),
            "mount": kind.mount.kind,
            "facets": len(kind.facets),
            "width_m": round(width, 3),
            "height_m": round(height, 3),
            "mirror_area_m2": round(areas[0], 3) if areas else None,
        }
    return types


def _surface(surface: AnyReceiver, described: PlantDescription) -> Report:
    aimed = sum(receiver == surface.name for receiver in described.receiver_of.values())
    return {
        "kind": _KINDS[type(surface)],
        "area_m2": round(lit_area(surface), 3),
        "absorptance": surface.absorptance,
        "heliostats": aimed,
    }


def lit_area(surface: AnyReceiver) -> float:
    """Area [m2] of a receiver's lit surface; that of a cavity is of its panels."""
    if isinstance(surface, Panels | Cavity):
        return sum(panel.width * panel.height for panel in surface.panels)
    return float(surface.width * surface.height)


def plant_lines(described: PlantDescription) -> list[str]:
    """The report in sentences for a person, without the table of types."""
    report, air = plant_report(described), described.optics.attenuation
    sun = ", ".join(
        f"{key} {_figure(value)}" for key, value in describe_sun(described.optics.sun_shape).items()
    )
    lost = np.polynomial.polynomial.polyval([0.5, 1.0], air or [0.0])
    lines = [
        f"{report['plant']}: {counted(len(described.plant.heliostats), 'heliostat')},"
        f" {report['mirror_area_m2']:,.0f} m2 of mirrors",
        f"sun: {sun}",
        f"air: {lost[0]:.1%} lost over 500 m, {lost[1]:.1%} over 1 km",
    ]
    for label in ("receivers", "targets"):
        surfaces = described.receivers if label == "receivers" else described.plant.targets
        for name, surface in surfaces.items():
            lines.append(
                f"{label[:-1]} {name}: {_KINDS[type(surface)]}, {lit_area(surface):,.1f} m2,"
                f" absorptance {surface.absorptance:g}"
            )
    if described.tower is not None:
        lines.append(
            f"tower: {described.tower.height:g} m high, radius {described.tower.radius:g} m"
        )
    if described.assumed:
        lines += [
            "assumed, as the file does not say:",
            *(f"  {line}" for line in described.assumed),
        ]
    return lines


def _figure(value: object) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def types_table(described: PlantDescription) -> Table:
    """Heliostat types in a table."""
    table = make_table(
        "heliostat types", "type", "heliostats", "mount", "facets", "size [m]", "mirror [m2]"
    )
    for name, kind in _types(described).items():
        assert isinstance(kind, dict)
        area = "" if kind["mirror_area_m2"] is None else f"{kind['mirror_area_m2']:.2f}"
        size = f"{kind['width_m']:.2f} x {kind['height_m']:.2f}"
        table.add_row(
            name, f"{kind['heliostats']:,}", kind["mount"], str(kind["facets"]), size, area
        )
    return table
