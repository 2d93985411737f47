"""Progress of a long computation, and its cancellation by an exception."""

from collections.abc import Callable
from dataclasses import dataclass, field

Progress = Callable[[str, int, int], None]
"""Receives the phase and the numbers of finished and of all steps; an exception ends the work."""


def silent(_phase: str, _done: int, _total: int) -> None:
    """Report nothing."""


def nothing_between() -> None:
    """Do nothing."""


@dataclass(eq=False)
class Steps:
    """Counts the steps of a computation, also of several threads.

    Attributes
    ----------
    report : Progress
        Receives substeps: `SUBSTEPS` of each step.
    phase : str
        What is being computed.
    total : int
        Number of steps.
    """

    report: Progress = silent
    phase: str = ""
    total: int = 0
    _done: list[None] = field(default_factory=list)  # its length counts: threads may append at once
    _begun: list[None] = field(default_factory=list)  # signs of life since the last finished step

    def alive(self) -> None:
        """Report the progress; an exception of the report ends the computation here."""
        self._begun.append(None)
        self._report()

    def advance(self) -> None:
        """Count a step as done."""
        self._done.append(None)
        self._begun.clear()
        self._report()

    def _report(self) -> None:
        total = SUBSTEPS * self.total
        done = SUBSTEPS * len(self._done) + min(len(self._begun), SUBSTEPS - 1)
        self.report(self.phase, min(done, total), total)


SUBSTEPS = 12
"""Substeps of a step: as many signs of life as a minimization gives on average."""
