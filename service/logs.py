"""How the processes of the service log."""

import logging

from service.settings import Settings

_FORMAT = "%(asctime)s %(levelname)s %(name)s %(message)s"


def set_up(settings: Settings) -> None:
    """Log to standard error, at the level that the settings name."""
    logging.basicConfig(level=settings.log_level.upper(), format=_FORMAT)
