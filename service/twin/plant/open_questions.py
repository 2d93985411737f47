"""What a study leaves open, which a person must know before its result is adopted."""

from dataclasses import dataclass

from service.store.results import StudyFindings

MOST_UNEXPLAINED = 0.5
"""Largest unexplained share of the error beyond noise that needs no reason."""


@dataclass(frozen=True)
class OpenQuestion:
    """What is not resolved, as a clause, and what would resolve it, as a sentence."""

    finding: str
    remedy: str


def open_questions(findings: StudyFindings) -> list[OpenQuestion]:
    """What a study leaves open: most of the error, and effects that look alike."""
    questions = []
    if findings.share_left > MOST_UNEXPLAINED:
        remedy = "See in the report what it varies with, and let a study try more effects."
        finding = f"{findings.share_left:.0%} of the error beyond noise is unexplained"
        questions.append(OpenQuestion(finding, remedy))
    for effect in () if findings.is_correction else findings.effects:
        photographs = effect.get("told_apart_by", {})
        for other in effect.get("lookalikes", ()):
            finding = f"the photographs cannot distinguish {effect['name']} from {other}"
            remedy = f"To decide, photograph {photographs[other]}." if other in photographs else ""
            questions.append(OpenQuestion(finding.replace("_", " "), remedy))
    return questions
