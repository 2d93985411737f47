"""The study of a measurement folder: ``heliotwin study``."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from model.effects import Effect, effect_to_json
from model.errors import InvalidInputError, ModelError
from model.study import FluxImage, Study, StudyOptions, study
from model.surface import DEGREE, control_points
from service.base.progress import Progress, quiet
from service.cli.folder import check_surfaces, clock_fault_of, evidence_of, with_surfaces
from service.cli.folder_pointing import Mounts
from service.sources.documents import Measurement, read_json
from service.sources.folder import MeasurementFolder


@dataclass(frozen=True, eq=False)
class FolderStudy:
    """A study, what of the folder it left out, with the reasons, and the effects that it took for known.

    ``clocks``: measurements whose time and sun disagree, with the likely reason.
    """

    study: Study
    skipped: dict[str, str]
    known: Sequence[Effect] = ()
    clocks: dict[str, str] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """The study's report, the model it was made with, and what was skipped where something was."""
        return {
            **self.study.to_json(),
            "model": {"effects": [effect_to_json(effect) for effect in self.known]},
            **({"skipped": self.skipped} if self.skipped else {}),
            **({"clocks": self.clocks} if self.clocks else {}),
        }


def photographs_of(
    folder: MeasurementFolder, surfaces: str = "measured", mounts: Mounts | None = None
) -> tuple[list[FluxImage], dict[str, str]]:
    """What a folder gives a study, and what it does not: heliostats and measurements with the reasons.

    On calibrated ``mounts`` photographs that these have not seen say, besides, where their motors sent the light.
    """
    known = mounts or Mounts(folder, None)
    photographs: list[FluxImage] = []
    skipped, seen = dict(folder.skipped), predicted_from(surfaces)
    for nominal, surface in with_surfaces(folder, surfaces, skipped):
        heliostat = known.stand(nominal)
        points, degree = (control_points(heliostat), DEGREE) if surface is None else surface
        for measurement in folder.measurements(heliostat.name):
            try:
                _require_on_target(folder, measurement)
                was_used = measurement.identifier in seen.get(heliostat.name, ())
                taken = evidence_of(folder, measurement).photograph(heliostat, points, degree, was_used)
                photographs.append(known.photograph(nominal, measurement, taken))
            except ModelError as error:
                skipped[measurement.key] = str(error)
    return photographs, skipped


def _require_on_target(folder: MeasurementFolder, measurement: Measurement) -> None:
    """A spot that is said to lie elsewhere makes a photograph of another target, or of another heliostat, likely."""
    target = folder.plant.targets[measurement.target]
    if measurement.spot is not None and not target.holds(measurement.spot):
        raise InvalidInputError(f"{measurement.key}: 'focal_spot' lies off its target {measurement.target}")


def predicted_from(surfaces: str) -> dict[str, list[str]]:
    """Identifiers of the photographs, by heliostat, that the surfaces of a folder of predictions were made from."""
    path = Path(surfaces) / "predictions.json"
    if surfaces in ("measured", "ideal") or not path.is_file():
        return {}
    try:
        return {name: list(entry["images"]) for name, entry in read_json(path)["heliostats"].items()}
    except (KeyError, TypeError, AttributeError):
        raise InvalidInputError(f"{path} is not as `heliotwin predict` writes it") from None


def study_folder(
    folder: MeasurementFolder,
    surfaces: str = "measured",
    options: StudyOptions | None = None,
    effects: Sequence[Effect] = (),
    progress: Progress = quiet,
    mounts: Mounts | None = None,
) -> FolderStudy:
    """Which effect a folder's photographs demand beyond its declared model and ``effects``, at its plant's latitude.

    Heliostats stand on calibrated ``mounts`` where there are any.

    Raises
    ------
    InvalidInputError
        Where too few photographs have a surface; it says what was left out.
    """
    check_surfaces(surfaces)
    photographs, skipped = photographs_of(folder, surfaces, mounts)
    known = [*folder.effects, *effects]
    try:
        latitude_deg = float(folder.plant.origin[0])
        found = study(photographs, folder.optics, known, options, progress, latitude_deg=latitude_deg)
    except InvalidInputError as error:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in list(skipped.items())[:5])
        raise InvalidInputError(f"{error}" + (f" ({reasons})" if reasons else "")) from None
    every = [one for name in folder.plant.heliostats for one in folder.measurements(name)]
    faults = {one.key: clock_fault_of(folder, one) for one in every}
    return FolderStudy(found, skipped, known, {key: fault for key, fault in faults.items() if fault is not None})
