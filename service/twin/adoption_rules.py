"""Which results of studies can be adopted, and what they leave open.

Effects can be adopted that are the cause, and tested corrections. A person must know the open
questions before.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from model.effects import CATALOGUE
from service.drawing.templates import CORRECTION
from service.store.results import StudyFindings

_TESTED = ("heliostats", "days")


def why_refused(findings: StudyFindings) -> str | None:
    """Why a study's result cannot be adopted, as a clause; None if it can.

    What explains a part of the error is no cause. A correction must not lose on heliostats or days
    that no fit saw, and one of them must be tested.
    """
    if findings.is_correction:
        return next(_losses(findings.transfer or {}), None)
    if not findings.effects:
        return "it found no effect; there is nothing to adopt"
    lacking = [name for name in names_of(findings) if name not in CATALOGUE]
    if lacking:
        return f"the file of its effect {lacking[0]} is not loaded (HELIOTWIN_EFFECTS_FROM)"
    if findings.verdict == "effect":
        return None
    part = ", ".join(names_of(findings))
    return (
        f"{part} explains only part of the error and is not its cause, so it"
        " cannot be adopted; let a study try more effects"
    )


def _losses(transfer: Mapping[str, Mapping[str, float] | None]) -> Iterator[str]:
    tested = {name: found for name in _TESTED if (found := transfer.get(name)) is not None}
    if not tested:
        yield (
            "its correction was tested neither on heliostats nor on days that no fit saw, so it"
            " cannot be adopted; let a study use more of them"
        )
    for name, found in tested.items():
        if found["after"] < found["before"]:
            yield (
                f"its correction makes forecasts of {name} that no fit saw worse"
                f" ({found['before']:.1%} before, {found['after']:.1%} after), so it cannot be"
                " adopted"
            )


def names_of(findings: StudyFindings) -> list[str]:
    """Names of what adopting a study's result adds to the model."""
    return (
        [CORRECTION] if findings.is_correction else [effect["name"] for effect in findings.effects]
    )


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


def is_ambiguous(findings: StudyFindings) -> bool:
    """Whether an effect looks like another one that changes forecasts for receivers otherwise.

    Of two that only images of targets show, either will do, and of two that ended.
    """
    return any(
        not (is_of_images(effect["name"]) and is_of_images(other))
        for effect in findings.effects
        if not (effect.get("scope") or {}).get("until")
        for other in effect.get("lookalikes", ())
    )


def is_of_images(name: str) -> bool:
    """Whether only images of targets show an effect; false for one that is not loaded."""
    kind = CATALOGUE.get(name)
    return kind is not None and kind.stage == "image"
