"""A picture with axes, a colour bar and a title."""

from service.web.responses.representation import Maps, Representation

PNG = "image/png"


def _write(maps: Maps) -> bytes:
    return maps.picture(maps.title)


REPRESENTATION = Representation((PNG,), "png", _write)
