"""The errors of the model; the service maps each to one HTTP status."""


class ModelError(Exception):
    """Base of all intended errors of the model; the message names the field and the remedy."""


class InvalidInputError(ModelError, ValueError):
    """An input is malformed: wrong shape, not finite, outside its bounds."""


class UnreachableError(ModelError):
    """The geometry has no solution: a target behind the mirror, or an unreachable attitude."""


class WeightsError(ModelError):
    """Shipped weights are missing or differ from their model card; the installation is damaged."""


class ImageRefusedError(ModelError):
    """A photograph cannot be measured; ``reason`` is the code in its quality record."""

    def __init__(self, reason: str, detail: str) -> None:
        super().__init__(f"{reason}: {detail}")
        self.reason = reason
        self.detail = detail
