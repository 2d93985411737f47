"""Progress: how work tells what it does and how far it is, and may be ended by what it tells."""

from collections.abc import Callable
from dataclasses import dataclass

Progress = Callable[[str], None]
"""Takes the name of what is done next."""

Report = Callable[[float, str], None]
"""Takes the share that is done, 0 to 1, and what is being done; what it raises ends the work."""


def quiet(_name: str) -> None:
    """A progress callback that says nothing."""


@dataclass(eq=False)
class Steps:
    """Turns the names of what is done one after the other into shares of ``total``."""

    total: int
    report: Report
    done: int = 0

    def __call__(self, name: str) -> None:
        """Report that ``name`` is done next."""
        self.report(self.done / max(self.total, 1), name)
        self.done += 1
