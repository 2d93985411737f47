"""The study of a measurement folder: ``heliotwin study``."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from heliotwin.folder import check_surfaces, predicted_from, surfaces_of
from heliotwin.folder_store import FolderStore, open_folder
from model.effects import Effect, effect_to_json
from model.errors import InvalidInputError
from model.study import Study, StudyOptions, study_to_json
from service.base.errors import list_reasons
from service.base.progress import Progress, no_progress
from service.sources.folder import MeasurementFolder, points_of
from service.twin.studies.study import StudyInputs


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


def photographs_of(opened: FolderStore, surfaces: str = "measured") -> StudyInputs:
    """Photographs of a folder for a study, and skipped heliostats and measurements with reasons."""
    seen, skipped = predicted_from(surfaces), opened.folder.skipped | opened.refused
    return opened.study_inputs(
        (
            (one.name, *points_of(one, surface), seen.get(one.name, ()))
            for one, surface in surfaces_of(opened.folder, surfaces, skipped)
        ),
        skipped,
    )


def study_photographs(
    opened: FolderStore,
    inputs: StudyInputs,
    options: StudyOptions | None = None,
    progress: Progress = no_progress,
) -> FolderStudy:
    """Find effects in photographs that the folder's model lacks; errors as of `study_folder`."""
    model = opened.model
    try:
        found = opened.runtime.operations.study(inputs.photographs, model, options, progress)
    except InvalidInputError as error:
        reasons = list_reasons(inputs.skipped, 5)
        raise InvalidInputError(f"{error}" + (f" ({reasons})" if reasons else "")) from None
    return FolderStudy(found, inputs.skipped, model.effects, opened.clocks())


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
    with open_folder(
        folder, effects=effects, mounts_file=mounts, with_camera=False
    ) as opened:  # the camera is a candidate
        return study_photographs(opened, photographs_of(opened, surfaces), options, progress)
