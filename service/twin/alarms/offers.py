"""Offers: requests of REST that do what an alarm or a cause asks for."""

from collections.abc import Iterable, Mapping, Sequence
from datetime import date, datetime, timedelta
from typing import Annotated, Literal

from pydantic import Field
from typing_extensions import TypedDict

from service.store import Studied
from service.twin.photographs.batches import MOST_ENTRIES
from service.twin.studies.study import MAX_STUDY_IMAGES


class Offer(TypedDict):
    """A request that does what an alarm or a cause asks for."""

    label: Annotated[str, Field(description="What it does.")]
    method: Annotated[Literal["POST", "PATCH", "PUT"], Field(description="Method of the request.")]
    path: Annotated[str, Field(description="Its path.")]
    body: Annotated[dict[str, object], Field(description="Its body as JSON.")]


_BEFORE = timedelta(days=21)  # that a study compares with what came after a change
_MOST_HELIOSTATS, _MOST_IMAGES = 12, 24  # of a study


def _post(label: str, path: str, **body: object) -> Offer:
    return Offer(label=label, method="POST", path=path, body=body)


def predict(label: str, heliostat: str, since: datetime | None = None) -> Offer:
    """Predict a surface, from photographs ``since`` a change if it is given."""
    change = {} if since is None else {"since": since.isoformat()}
    return _post(label, "/v1/jobs/predictions", heliostats=[heliostat], method="refined", **change)


def activate(heliostat: str, version: int, reason: str) -> Offer:
    """Make a version of a heliostat's surface active."""
    path = f"/v1/heliostats/{heliostat}/surfaces/current"
    body: dict[str, object] = {"version": version, "reason": reason[:200]}
    return Offer(label=f"Make version {version} active", method="PUT", path=path, body=body)


def calibrate(heliostats: Sequence[str]) -> Offer:
    """Calibrate mounts together."""
    label = "Calibrate its mount again" if len(heliostats) == 1 else "Calibrate their mounts again"
    return _post(label, "/v1/jobs/calibrations", heliostats=list(heliostats))


def study(heliostats: Sequence[str] | None, since: datetime | None) -> Offer:
    """Study photographs before and ``since`` a change, of some heliostats or of the field."""
    names = None if heliostats is None else list(heliostats)[:_MOST_HELIOSTATS]
    images = min(MAX_STUDY_IMAGES // len(names or range(_MOST_HELIOSTATS)), _MOST_IMAGES)
    change = {} if since is None else {"since": (since - _BEFORE).isoformat()}
    label = "Study its photographs" if names and len(names) == 1 else "Study their photographs"
    return _post(label, "/v1/jobs/studies", heliostats=names, images=images, **change)


def declare_counts(reason: str) -> Offer:
    """Declare images without background as sRGB counts, and measure all photographs again."""
    label = "Declare their camera, and measure them again"
    return _post(label, "/v1/jobs/measurements", camera="srgb", reason=reason[:200])


def has_seen(studies: Iterable[Studied], until: datetime, heliostat: str | None = None) -> bool:
    """Whether a study included photographs up to a time, of a heliostat or else of several."""
    return any(
        one.last_taken_at is not None
        and one.last_taken_at >= until
        and (len(one.heliostats) > 1 if heliostat is None else heliostat in one.heliostats)
        for one in studies
    )


def adopt(number: int, ends: Mapping[str, date], reason: str) -> Offer:
    """Adopt a study, whose effects have some ``ends``, for a ``reason``."""
    until = {effect: day.isoformat() for effect, day in ends.items()}
    said = f", ended by {', '.join(sorted(set(until.values())))}" if until else ""
    return _post(
        f"Adopt study {number}{said}",
        f"/v1/studies/{number}/adopt",
        until=until,
        reason=reason[:200],
    )


def withdraw(number: int) -> Offer:
    """Withdraw what was adopted from a study."""
    return _post(f"Withdraw study {number}", f"/v1/studies/{number}/withdraw")


def acknowledge(label: str, alarms: Sequence[str], reason: str) -> Offer:
    """Acknowledge alarms."""
    return _post(label, "/v1/alarms/acknowledgements", ids=list(alarms), reason=reason)


def exclude(heliostat: str, photograph: str, reason: str, is_used: bool) -> Offer:
    """Exclude a photograph, and predict the surface again if it ``is_used`` by that."""
    path = f"/v1/heliostats/{heliostat}/measurements/{photograph}"
    body: dict[str, object] = {"excluded": True, "reason": reason[:200], "predict_again": is_used}
    return Offer(label=f"Exclude photograph {photograph}", method="PATCH", path=path, body=body)


def correct_times(times: Sequence[tuple[str, str, datetime]], hours: float) -> Offer:
    """Correct times of a clock that is ``hours`` ahead: heliostats, photographs, recorded times."""
    times = times[:MOST_ENTRIES]
    entries = [
        {"heliostat": name, "id": number, "taken_at": (at - timedelta(hours=hours)).isoformat()}
        for name, number, at in times
    ]
    size = f"{abs(hours):g} h"
    count = f"{len(times)} photographs" if len(times) > 1 else "its photograph"
    label = f"Set the times of {count} {size} {'earlier' if hours > 0 else 'later'}"
    reason = f"the suns say that the clock was {size} {'ahead' if hours > 0 else 'behind'}"
    body: dict[str, object] = {"reason": reason, "times": entries}
    return Offer(label=label, method="PATCH", path="/v1/measurements/times", body=body)
