"""What became of studies, and what to know before their results are adopted."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from sqlalchemy.orm import Session

from service import store
from service.store.results import StudyFindings
from service.store.tables import ModelRow, StudyRow
from service.twin.plant import model_versions
from service.twin.plant.adoption_rules import names_of, why_refused
from service.twin.plant.open_questions import OpenQuestion, open_questions

AdoptionState = Literal["active", "replaced", "withdrawn", "candidate", "nothing_to_adopt"]


@dataclass(frozen=True)
class StudyState:
    """A study's findings, and the newest version adopted from it.

    ``state`` is "replaced" if a later version is current. ``warnings`` are the conflicts that
    adoption by force ignores. ``current`` is the number of the current version. ``refusal`` says
    why it cannot be adopted, None if it can. ``adopts`` names what adoption adds.
    """

    findings: StudyFindings
    version: ModelRow | None
    state: AdoptionState
    questions: list[OpenQuestion]
    warnings: list[str]
    current: int
    refusal: str | None
    adopts: list[str]

    @property
    def is_adoptable(self) -> bool:
        """Whether it can be adopted, and is not."""
        return self.refusal is None and self.state in ("candidate", "withdrawn")

    @property
    def adopted(self) -> int | None:
        """Number of the version that was adopted from it, unless it is withdrawn."""
        return None if self.version is None or self.version.withdrawn_at else self.version.number


def study_states(session: Session, rows: Sequence[StudyRow]) -> dict[int, StudyState]:
    """The states of studies, by id."""
    numbers = [row.id for row in rows]
    findings, current = (
        store.study_findings(session, numbers),
        model_versions.current_number(session),
    )
    versions = model_versions.newest_of(session, numbers)
    return {row.id: _state(row, findings[row.id], versions.get(row.id), current) for row in rows}


def _state(
    row: StudyRow, findings: StudyFindings, version: ModelRow | None, current: int
) -> StudyState:
    refusal = why_refused(findings)
    state: AdoptionState = "candidate" if refusal is None else "nothing_to_adopt"
    if version is not None:
        is_active = version.number == current
        state = "withdrawn" if version.withdrawn_at else "active" if is_active else "replaced"
    warnings = []
    if row.model != current:
        warnings.append(
            f"it was made with version {row.model} of the model, and would replace version"
            f" {current}, which is current"
        )
    questions, adopts = open_questions(findings), names_of(findings)
    return StudyState(findings, version, state, questions, warnings, current, refusal, adopts)
