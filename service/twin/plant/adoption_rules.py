"""Which results of studies can be adopted: effects that are the cause, and tested corrections."""

from collections.abc import Iterator, Mapping

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
    if findings.verdict == "effect":
        return None
    part = ", ".join(str(effect["name"]) for effect in findings.effects)
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
