"""From rows to what is sent: JSON models, npz files and pictures."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from fastapi import Response
from fastapi.responses import JSONResponse
from numpy.typing import NDArray
from pydantic import BaseModel
from sqlalchemy.orm import Session

from model.images import FLUX_SUM
from service import models, negotiation
from service.arrays import pack, unpack
from service.faults import NotFoundError
from service.pictures import flux_picture, surface_picture
from service.schemas import (
    AuditOut,
    ForecastSummary,
    HeliostatOut,
    HeliostatSummary,
    Item,
    JobOut,
    MeasurementOut,
    ModelOut,
    Page,
    PlantOut,
    ReceiverOut,
    StudyOut,
    StudySummary,
    SurfaceOut,
    SurfaceSummary,
    TargetOut,
)
from service.tables import (
    AuditRow,
    ForecastRow,
    HeliostatRow,
    JobRow,
    MeasurementRow,
    ModelRow,
    PlantRow,
    ReceiverRow,
    StudyRow,
    SurfaceRow,
    TargetRow,
)


def page(items: Sequence[Item], limit: int, mark: str = "id") -> Page[Item]:
    """The first ``limit`` of items that are up to one more; after the last one's ``mark`` begins the next page."""
    shown = list(items[:limit])
    return Page(items=shown, next=str(getattr(shown[-1], mark)) if len(items) > limit else None)


def _json(model: BaseModel, **arrays: Any) -> Response:
    """A model with arrays beside it that are not worth checking number by number."""
    plain = {name: None if array is None else np.asarray(array).tolist() for name, array in arrays.items()}
    return JSONResponse({**model.model_dump(mode="json"), **plain}, headers={"Vary": "Accept"})


def _file(content: bytes, media_type: str, name: str) -> Response:
    headers = {"Vary": "Accept", "Content-Disposition": f'inline; filename="{name}"'}
    return Response(content, media_type=media_type, headers=headers)


def _pair(first: float | None, second: float | None) -> tuple[float, float] | None:
    return None if first is None or second is None else (first, second)


def plant(row: PlantRow) -> PlantOut:
    """A plant as JSON."""
    return PlantOut(name=row.name, origin_wgs84=row.origin, declared=row.declared)


def heliostat_summary(row: HeliostatRow) -> HeliostatSummary:
    """A heliostat without its properties."""
    return HeliostatSummary(name=row.name, position_m=(row.east_m, row.north_m, row.up_m))


def heliostat(row: HeliostatRow) -> HeliostatOut:
    """A heliostat as JSON."""
    position = (row.east_m, row.north_m, row.up_m)
    return HeliostatOut(name=row.name, position_m=position, properties=row.properties, updated_at=row.updated_at)


def target(row: TargetRow) -> TargetOut:
    """A target plane as JSON."""
    return TargetOut.model_validate(
        {
            "name": row.name,
            "center": row.center_m,
            "normal": row.normal,
            "up": row.up,
            "width": row.width_m,
            "height": row.height_m,
            "corners": row.corners,
        }
    )


def receiver(row: ReceiverRow) -> ReceiverOut:
    """A cylindrical receiver as JSON."""
    return ReceiverOut.model_validate(
        {
            "name": row.name,
            "center": row.center_m,
            "normal": row.normal,
            "up": row.up,
            "radius": row.radius_m,
            "height": row.height_m,
            "opening_deg": row.opening_deg,
        }
    )


def measurement(heliostat_name: str, row: MeasurementRow) -> MeasurementOut:
    """A measurement as JSON."""
    return MeasurementOut.model_validate(
        {
            "id": row.identifier,
            "heliostat": heliostat_name,
            "external_id": row.external_id,
            "kind": row.kind,
            "target_name": row.target.name,
            "sun_azimuth": row.sun_azimuth_deg,
            "sun_elevation": row.sun_elevation_deg,
            "motor_position": _pair(row.motor_axis_1, row.motor_axis_2),
            "taken_at": row.taken_at,
            "focal_spot": row.focal_spot_wgs84,
            "accepted": row.accepted,
            "reason": row.reason,
            "quality": row.quality,
            "center_of_mass": _pair(row.center_right_m, row.center_up_m),
            "image_sha256": row.image_sha256,
            "image_media_type": row.image.media_type,
            "created_at": row.created_at,
        }
    )


def measured_flux(heliostat_name: str, row: MeasurementRow, media_type: str) -> Response:
    """The flux of a measurement; NotFoundError for a refused image, which has none."""
    if row.arrays is None:
        raise NotFoundError(f"measurement {row.identifier} was refused ({row.reason}), so it has no flux")
    arrays = unpack(row.arrays)
    name = f"{heliostat_name}-{row.identifier}-flux"
    if media_type == negotiation.PNG:
        whole = "flux" in arrays
        size = (row.target.width_m, row.target.height_m) if whole else None
        shown = arrays["flux" if whole else "centered"]
        title = f"{heliostat_name} {row.identifier}, measured"
        return _file(flux_picture(shown, size, "flux [% per pixel]", title), media_type, f"{name}.png")
    if media_type != negotiation.JSON:
        return _file(row.arrays, media_type, f"{name}.npz")
    return _json(measurement(heliostat_name, row), flux=arrays.get("flux"), centered=arrays.get("centered"))


def surface_summary(heliostat_name: str, row: SurfaceRow) -> SurfaceSummary:
    """A surface without its arrays."""
    return SurfaceSummary.model_validate(
        {
            "heliostat": heliostat_name,
            "version": row.version,
            "source": row.source,
            "model": row.model,
            "model_version": row.model_version,
            "created_at": row.created_at,
            "valid_from": row.valid_from,
            "measurements": [measurement.identifier for measurement in row.measurements],
            "misfit": row.misfit,
        }
    )


def surface_full(heliostat_name: str, row: SurfaceRow) -> SurfaceOut:
    """A surface with its arrays as JSON."""
    arrays = {name: array.tolist() for name, array in unpack(row.arrays).items()}
    return SurfaceOut.model_validate({**surface_summary(heliostat_name, row).model_dump(), **arrays})


def surface(heliostat_name: str, row: SurfaceRow, media_type: str) -> Response:
    """A surface as the client wants it."""
    name = f"{heliostat_name}-surface-{row.version}"
    if media_type == negotiation.PNG:
        title = f"{heliostat_name}, surface {row.version} ({row.source})"
        return _file(surface_picture(unpack(row.arrays)["z"], title), media_type, f"{name}.png")
    if media_type != negotiation.JSON:
        return _file(row.arrays, media_type, f"{name}.npz")
    return _json(surface_summary(heliostat_name, row), **unpack(row.arrays))


def forecast_summary(row: ForecastRow) -> ForecastSummary:
    """A forecast without its pixels."""
    return ForecastSummary.model_validate(
        {
            "id": row.id,
            "heliostat": row.heliostat.name,
            "surface_version": None if row.surface is None else row.surface.version,
            "target": row.target_name,
            "plane": row.plane,
            "sun": {"azimuth_deg": row.sun_azimuth_deg, "elevation_deg": row.sun_elevation_deg},
            "aim_point": row.aim_point_m,
            "dni_w_m2": row.dni_w_m2,
            "window": row.window_m,
            "resolution": (row.rows, row.columns),
            "normalised": row.normalised,
            "unit": "1" if row.normalised else "W/m2",
            "peak_w_m2": row.peak_w_m2,
            "power_w": row.power_w,
            "center_of_mass": _pair(row.center_right_m, row.center_up_m),
            "model_version": row.model_version,
            "created_at": row.created_at,
        }
    )


def _study_fields(row: StudyRow, adopted: str | None) -> dict[str, Any]:
    names = StudySummary.model_fields.keys() - {"adopted"}
    return {name: getattr(row, name) for name in names} | {"adopted": adopted}


def study_summary(row: StudyRow, adopted: str | None) -> StudySummary:
    """A study without its figures; ``adopted`` is the version that stands for what it found."""
    return StudySummary.model_validate(_study_fields(row, adopted))


def study(row: StudyRow, adopted: str | None) -> StudyOut:
    """A study, loaded with its report, as JSON."""
    return StudyOut.model_validate({**row.report, **_study_fields(row, adopted), "skipped": row.skipped})


def declared_model(is_current: bool) -> ModelOut:
    """The model that nobody had to adopt."""
    unknown = dict.fromkeys(("study", "adopted_at", "adopted_by", "withdrawn_at", "withdrawn_by"))
    about = {"number": models.DECLARED, "version": models.version_name(models.DECLARED, ()), "effects": []}
    return ModelOut.model_validate({**about, "is_current": is_current, **unknown})


def model(row: ModelRow, is_current: bool) -> ModelOut:
    """An adopted version of the plant's model."""
    names = ModelOut.model_fields.keys() - {"is_current", "study"}
    fields = {name: getattr(row, name) for name in names}
    return ModelOut.model_validate({**fields, "is_current": is_current, "study": row.study_id})


def all_models(session: Session) -> list[ModelOut]:
    """All versions of the plant's model, oldest first, withdrawn ones too."""
    current = models.current_number(session)
    adopted = [model(row, row.number == current) for row in models.list_models(session)]
    return [declared_model(current == models.DECLARED), *adopted]


def job(row: JobRow) -> JobOut:
    """A job as JSON."""
    return JobOut.model_validate(row, from_attributes=True)


def job_flux(row: JobRow, media_type: str) -> Response:
    """The flux map of a job; NotFoundError where it has none."""
    if row.arrays is None or row.result is None:
        raise NotFoundError(f"job {row.id} ({row.kind}, {row.state}) has no flux map")
    flux, name = unpack(row.arrays)["flux"], f"job-{row.id}-flux"
    if media_type == negotiation.PNG:
        plane = row.result["plane"]
        title = f"job {row.id}, {row.result['heliostats']} heliostats"
        return _file(flux_picture(flux, (plane["width"], plane["height"]), "W/m²", title), media_type, f"{name}.png")
    if media_type != negotiation.JSON:
        return _file(row.arrays, media_type, f"{name}.npz")
    return _json(job(row), flux=flux)


def audit_entry(row: AuditRow) -> AuditOut:
    """An entry of the audit trail as JSON."""
    return AuditOut.model_validate(row, from_attributes=True)


def flux_of(row: ForecastRow) -> NDArray[np.float32]:
    """The map in the unit that was asked for."""
    flux = unpack(row.flux)["flux"]
    total = float(flux.sum(dtype=np.float64))
    return flux * np.float32(FLUX_SUM / total) if row.normalised and total > 0 else flux


def forecast(row: ForecastRow, media_type: str) -> Response:
    """A forecast as the client wants it."""
    flux = flux_of(row)
    name = f"{row.heliostat.name}-forecast-{row.id}"
    if media_type == negotiation.PNG:
        unit = "flux [% per pixel]" if row.normalised else "W/m²"
        size = (row.window_m or row.plane["width"], row.window_m or row.plane["height"])
        title = f"{row.heliostat.name}, forecast {row.id}"
        return _file(flux_picture(flux, size, unit, title), media_type, f"{name}.png")
    if media_type != negotiation.JSON:
        return _file(pack({"flux": flux}), media_type, f"{name}.npz")
    return _json(forecast_summary(row), flux=flux)
