"""What can go wrong in the service beside the model's errors; `service.web.answers.problems` has the statuses."""

from model.errors import ModelError


class ServiceError(Exception):
    """Base of what the service raises on purpose; the message is for the caller."""


class NotFoundError(ServiceError):
    """A named thing is not in the store."""


class ConflictError(ServiceError):
    """The request is well-formed but the store is in no state to fulfil it; the message says what to do first."""


class GoneError(ServiceError):
    """A named thing was in the store and is kept no longer."""


class StoreFullError(ServiceError):
    """The store may keep no more, and has nothing that it may give up."""


class TooLargeError(ServiceError):
    """A body or an image exceeds its bound."""


class TooManyError(ServiceError):
    """More is asked at a time than is allowed; what is there must be done first."""


class BusyError(ServiceError):
    """Others were first, and their work did not end in time; the same may be asked again in a while."""


class UnsupportedImageError(ServiceError):
    """An image file of a format that is not accepted."""


class UnsupportedContentError(ServiceError):
    """A request body of a media type that the route does not take."""


class NotAcceptableError(ServiceError):
    """None of the representations on offer is acceptable to the client; ``offered`` lists them."""

    def __init__(self, offered: tuple[str, ...]) -> None:
        super().__init__(f"Accept: nothing acceptable; this resource is offered as {', '.join(offered)}")
        self.offered = offered


class StoreDamagedError(ServiceError):
    """What the store promised to keep is gone or altered: the operator's business, not the caller's."""


class OpenDoorError(ServiceError):
    """The service would be open to other machines without anybody's leave."""


class NotStartedError(ServiceError):
    """The service did not start."""


class SchemaError(ServiceError):
    """The database's schema is not the one that this code works with: the operator's business."""


SKIPPED = (ModelError, ServiceError)
"""What one heliostat or photograph may lack without ending the work on the others."""
