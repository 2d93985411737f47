"""What a study leaves open, which a person must know before its result is adopted."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

MOST_UNEXPLAINED = 0.5
"""Largest unexplained share of the error beyond noise that needs no reason."""


@dataclass(frozen=True)
class OpenQuestion:
    """What is not resolved, as a clause, and what would resolve it, as a sentence."""

    finding: str
    remedy: str


def open_questions(
    effects: Iterable[Mapping[str, Any]], unexplained_share: float
) -> list[OpenQuestion]:
    """What a study leaves open: most of the error, and effects that look alike.

    ``effects`` and ``unexplained_share`` are those of its report.
    """
    questions = []
    if unexplained_share > MOST_UNEXPLAINED:
        remedy = "See in the report what it varies with, and let a study try more effects."
        finding = f"{unexplained_share:.0%} of the error beyond noise is unexplained"
        questions.append(OpenQuestion(finding, remedy))
    for effect in effects:
        photographs = effect.get("told_apart_by", {})
        for other in effect.get("lookalikes", ()):
            finding = f"the photographs cannot distinguish {effect['name']} from {other}"
            remedy = f"To decide, photograph {photographs[other]}." if other in photographs else ""
            questions.append(OpenQuestion(finding.replace("_", " "), remedy))
    return questions
