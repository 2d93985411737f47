"""Errors of the service in addition to the model's.

`service.web.responses.problems` maps them to HTTP status codes.
"""

from collections.abc import Mapping

from model.errors import InvalidInputError, ModelError


def list_reasons(skipped: Mapping[str, str], most: int = 3) -> str:
    """The first of the skipped items with their reasons, in one line."""
    return "; ".join(f"{name}: {reason}" for name, reason in list(skipped.items())[:most])


class ServiceError(Exception):
    """Base class of expected errors. Their messages are for the caller."""


class NotFoundError(ServiceError):
    """A named resource is not in the store."""


class ConflictError(ServiceError):
    """A valid request that the current state of the store does not allow.

    The message says what to do first.
    """


class IdempotencyReuseError(InvalidInputError):
    """An Idempotency-Key that named another request."""


class GoneError(ServiceError):
    """A named resource was deleted from the store."""


class StoreFullError(ServiceError):
    """The store is full, and nothing in it may be deleted."""


class InvalidEntriesError(InvalidInputError):
    """Invalid entries of a list, with the reason for each index; ``where`` is the list's field."""

    def __init__(self, where: str, wrong: Mapping[int, str]) -> None:
        first = "; ".join(f"{where}.{place}: {why}" for place, why in list(wrong.items())[:5])
        super().__init__(f"nothing was kept; {len(wrong)} entries are wrong: {first}")
        self.where, self.wrong = where, dict(wrong)


class TooLargeError(ServiceError):
    """A request body or an image exceeds its limit."""


class TooManyError(ServiceError):
    """Too many requests or jobs at a time. Earlier ones must finish first."""


class BusyError(ServiceError):
    """Others were first, and did not finish in time. The caller may try again later."""


class UnsupportedImageError(ServiceError):
    """An image file of an unsupported format."""


class UnsupportedContentError(ServiceError):
    """A request body of a media type that the route does not accept."""


class NotAcceptableError(ServiceError):
    """The client accepts none of the available representations; ``offered`` lists them."""

    def __init__(self, offered: tuple[str, ...]) -> None:
        super().__init__(
            f"Accept: nothing acceptable; this resource is offered as {', '.join(offered)}"
        )
        self.offered = offered


class StoreDamagedError(ServiceError):
    """Stored data are missing or altered. The operator must act, not the caller."""


class UnauthenticatedExposureError(ServiceError):
    """The service would be reachable from other machines without authentication."""


class NotStartedError(ServiceError):
    """The service did not start."""


class SchemaError(ServiceError):
    """The database schema does not fit this version. The operator must act."""


SKIPPED = (ModelError, ServiceError)
"""Errors of one heliostat or photograph that do not stop the work on others."""
