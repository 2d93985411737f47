"""Measured comparisons, which print their figures and write them to ``results/``.

They compute in as many threads as the service does, which says so when it is imported: before NumPy
and torch are.
"""

import os
from pathlib import Path

import service  # noqa: F401


def data_folder() -> Path:
    """Where the real measurements lie: ``HELIOTWIN_STJ``, ``../shared/stj`` unless set."""
    return Path(os.environ.get("HELIOTWIN_STJ", "../shared/stj"))
