"""The study of a measurement folder: ``heliotwin study``."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from model.effects import Effect, effect_to_json
from model.errors import InvalidInputError
from model.study import FluxImage, Study, StudyOptions, study_to_json
from service.base.errors import list_reasons
from service.base.progress import Progress, no_progress
from service.cli.folder import check_surfaces, points_of, predicted_from, surfaces_of
from service.cli.folder_store import FolderStore, open_folder
from service.sources.folder import MeasurementFolder
from service.twin.studies.study import StudyInputs, add_photographs


@dataclass(frozen=True, eq=False)
class FolderStudy:
    """A study of a folder, what it skipped, and the model's effects before it.

    ``skipped``: parts of the folder that were left out, with reasons. ``known``: the effects of the
    model before the study. ``clocks``: measurements whose time and sun disagree, with the likely
    reason.
    """

    study: Study
    skipped: dict[str, str]
    known: Sequence[Effect] = ()
    clocks: dict[str, str] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """The study's report with the model's effects, skipped items and clock faults."""
        return {
            **study_to_json(self.study),
            "model": {"effects": [effect_to_json(effect) for effect in self.known]},
            **({"skipped": self.skipped} if self.skipped else {}),
            **({"clocks": self.clocks} if self.clocks else {}),
        }


def photographs_of(
    opened: FolderStore, surfaces: str = "measured"
) -> tuple[list[FluxImage], dict[str, str]]:
    """Photographs of a folder for a study, and skipped heliostats and measurements with reasons.

    With calibrated mounts, a photograph that is newer than them also has the pointing from its
    motors.
    """
    folder, seen = opened.folder, predicted_from(surfaces)
    inputs = StudyInputs(skipped=folder.skipped | opened.refused)
    for heliostat, surface in surfaces_of(folder, surfaces, inputs.skipped):
        name = heliostat.name
        twin, (rows, refused) = opened.context(name), opened.photographs(name)
        inputs.skipped |= {f"{name}/{key}": reason for key, reason in refused.items()}
        points, degree = points_of(twin.heliostat, surface)
        add_photographs(opened.session, inputs, twin, rows, points, degree, seen.get(name, ()))
    return inputs.photographs, inputs.skipped


def study_folder(
    folder: MeasurementFolder,
    surfaces: str = "measured",
    options: StudyOptions | None = None,
    effects: Sequence[Effect] = (),
    progress: Progress = no_progress,
    mounts: Path | None = None,
) -> FolderStudy:
    """Find effects in a folder's photographs that the declared model and ``effects`` lack.

    ``mounts`` is a file of `heliotwin calibrate`.

    Raises
    ------
    InvalidInputError
        If too few photographs have a surface; the message lists what was skipped.
    """
    check_surfaces(surfaces)
    with open_folder(folder, effects=effects, mounts_file=mounts) as opened:
        model, clocks = opened.model, opened.clocks()
        photographs, skipped = photographs_of(opened, surfaces)
        try:
            found = opened.runtime.operations.study(photographs, model, options, progress)
        except InvalidInputError as error:
            reasons = list_reasons(skipped, 5)
            raise InvalidInputError(f"{error}" + (f" ({reasons})" if reasons else "")) from None
    return FolderStudy(found, skipped, list(model.effects), clocks)
