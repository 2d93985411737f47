"""Sentences of the integrators' guide, each with a test."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

PAGE = "docs/how-to/integrator/photographs.md"
GUIDE = " ".join((Path(__file__).parents[3] / PAGE).read_text(encoding="utf-8").split())

Test = TypeVar("Test", bound=Callable[..., Any])


def promise(*sentences: str) -> Callable[[Test], Test]:
    """Name the guide's sentences that a test holds the service to."""

    def marked(test: Test) -> Test:
        missing = [sentence for sentence in sentences if sentence not in GUIDE]
        assert not missing, (
            f"{PAGE} no longer says {missing}; change {test.__name__} with the guide"
        )
        return test

    return marked
