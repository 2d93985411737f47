"""Names that are safe in paths, URLs and file names."""

import re

from model.errors import InvalidInputError

NAME = r"^[A-Za-z0-9][A-Za-z0-9_-]{0,31}$"
"""Of heliostats, targets and the plant."""

IDENTIFIER = r"^[A-Za-z0-9][A-Za-z0-9_-]{0,63}$"
"""Of measurements, as their sender calls them."""

MEASUREMENT = r"^[A-Za-z0-9][A-Za-z0-9_-]{0,95}$"
"""Of measurements, as the service calls them."""

FORMS = {
    pattern: f"1 to {most} letters, digits, underscores and hyphens, the first a letter or digit"
    for pattern, most in ((NAME, 32), (IDENTIFIER, 64), (MEASUREMENT, 96))
}
"""The same in words."""


def require(pattern: str, value: str, what: str) -> None:
    """Raise `InvalidInputError` unless ``value`` fits ``pattern``; ``what`` says which name it is."""
    if re.fullmatch(pattern, value) is None:
        raise InvalidInputError(f"{what} {value[:40]!r}: must be {FORMS[pattern]}")
