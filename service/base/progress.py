"""Progress reports of long work, which can also stop the work."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

Progress = Callable[[str], None]
"""Callback that takes the name of the next step."""


class Report(Protocol):
    """Callback for the completed share, 0 to 1, and the current activity.

    If it raises an exception, the work stops. ``phase`` describes the units of ``n_done`` and
    ``n_total``.
    """

    def __call__(
        self,
        share: float,
        message: str,
        *,
        phase: str = "",
        n_done: int | None = None,
        n_total: int | None = None,
    ) -> None:
        """Receive a report."""


def no_report(share: float, message: str, **counts: Any) -> None:
    """Ignore a report."""


def no_progress(_name: str) -> None:
    """Ignore a step."""


@dataclass(eq=False)
class NamedSteps:
    """Convert step names to shares of ``total`` steps; ``phase`` describes the units."""

    total: int
    report: Report
    phase: str = ""
    begun: int = 0
    name: str = ""

    def __call__(self, name: str) -> None:
        """Report that step ``name`` begins."""
        self.name = name
        self.begun += 1
        self.alive()

    def alive(self) -> None:
        """Repeat the last report, so that the work can also be stopped between steps."""
        done = min(max(self.begun - 1, 0), self.total)
        self.report(
            done / max(self.total, 1), self.name, phase=self.phase, n_done=done, n_total=self.total
        )
