"""Measured comparisons: ``make bench`` prints the figures of RESULTS.md."""

import os
from pathlib import Path


def data_folder() -> Path:
    """Where the real measurements lie: ``HELIOTWIN_STJ``, ``../shared/stj`` unless set."""
    return Path(os.environ.get("HELIOTWIN_STJ", "../shared/stj"))
