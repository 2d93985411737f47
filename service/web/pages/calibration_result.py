"""What the page of a calibration shows: mounts, steps, contradicting photographs and skips."""

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from model.pointing.report import clock_in_words
from service.store.job_tables import JobRow
from service.store.tables import HeliostatRow, MountRow
from service.twin.pointing.calibration import UndatedCount

MOST = 100
"""Most mounts, steps and photographs on a page."""

OFFSETS = {
    "first_zero": "First drive's zero [mrad]",
    "second_zero": "Second drive's zero [mrad]",
    "foundation_up": "Foundation about up [mrad]",
    "foundation_north": "About north [mrad]",
}
"""Headings of the shown parameters of a mount."""


@dataclass(frozen=True)
class CalibrationView:
    """The result of a calibration.

    ``mounts`` has documents by heliostat. ``outliers`` are
    (heliostat, photograph, detail), and ``skipped`` (heliostat, photograph or "") by reason.
    """

    versions: Mapping[str, int]
    mounts: Mapping[str, Mapping[str, Any]]
    steps: list[tuple[str, Mapping[str, object]]]
    outliers: list[tuple[str, str, str]]
    skipped: Mapping[str, list[tuple[str, str]]]
    clock: str | None
    undated: str | None

    @property
    def longest(self) -> int:
        """Length of the longest list."""
        lists = self.versions, self.steps, self.outliers, *self.skipped.values()
        return max(map(len, lists))


def _step(step: Mapping[str, Any]) -> Mapping[str, object]:
    ends = {end: datetime.fromisoformat(step[end]) for end in ("from", "to")}
    return {"detail": "", "std_mrad": None} | dict(step) | ends


def calibration_view(
    session: Session, job: JobRow, result: Mapping[str, Any], begin: int
) -> CalibrationView | None:
    """The view of a finished calibration, with mounts from the index ``begin``; None for other
    jobs.
    """
    if job.kind != "calibrations" or "mounts" not in result:
        return None
    versions: Mapping[str, int] = result["mounts"]
    names = sorted(versions)[begin : begin + MOST]
    rows = session.execute(
        select(HeliostatRow.name, MountRow)
        .join(MountRow, MountRow.heliostat_id == HeliostatRow.id)
        .where(HeliostatRow.name.in_(names))
    )
    documents = {name: mount.document for name, mount in rows if mount.version == versions[name]}
    skipped = dict[str, list[tuple[str, str]]]()
    for key, reason in sorted(result.get("skipped", {}).items()):
        name, _, photograph = key.partition("/")
        skipped.setdefault(reason, []).append((name, photograph))
    undated = result.get("undated")
    return CalibrationView(
        versions,
        {name: documents[name] for name in names if name in documents},
        [
            (name, _step(step))
            for name, steps in sorted(result.get("steps", {}).items())
            for step in reversed(steps)
        ],
        [
            (*key.split("/", 1), found["detail"])
            for key, found in sorted(result.get("outliers", {}).items())
        ],
        skipped,
        clock_in_words(result["clock"]) if result.get("clock") else None,
        UndatedCount(**undated).in_words() if undated else None,
    )
