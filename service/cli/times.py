"""Times of the command line's options."""

from datetime import datetime

from model.errors import InvalidInputError
from service.base.fields import parse_moment


def moment_of(at: datetime | None) -> datetime | None:
    """The time of ``--at`` in UTC; `InvalidInputError` for an implausible year."""
    try:
        return None if at is None else parse_moment(at)
    except ValueError as error:
        raise InvalidInputError(f"--at: {error}") from None
