"""The few errors that the model raises; the service maps each to one HTTP status."""


class ModelError(Exception):
    """Base of everything the model raises on purpose; the message names the field and the remedy."""


class InvalidInputError(ModelError, ValueError):
    """An input is malformed: wrong shape, not finite, outside its bounds."""


class UnreachableError(ModelError):
    """The geometry has no solution: a target behind the mirror, an orientation the mount cannot reach."""


class ImageRefusedError(ModelError):
    """A photograph cannot be measured; ``reason`` is the short code that its quality record keeps."""

    def __init__(self, reason: str, detail: str) -> None:
        super().__init__(f"{reason}: {detail}")
        self.reason = reason
        self.detail = detail
