"""Representations other than JSON, and content negotiation."""

from collections.abc import AsyncIterator
from dataclasses import dataclass
from importlib import import_module
from typing import Annotated, Any

import numpy as np
import orjson
from fastapi import Depends, Header, Query, Request, Response
from pydantic import BaseModel

from service.base.errors import NotAcceptableError
from service.web.auth.dependencies import render_slot
from service.web.responses.representations import Maps, Representation

JSON = "application/json"

OFFERED = ("representations",)
"""Modules with `REPRESENTATIONS`, in order of preference if a client accepts several equally."""

_WRITERS: dict[str, Representation] = {
    media_type: representation
    for name in OFFERED
    for representation in import_module(f"service.web.responses.{name}").REPRESENTATIONS
    for media_type in representation.media_types
}

ARRAYS = (JSON, *_WRITERS)
"""Media types of flux maps and surfaces, the default first."""

# Short names for links, because a link has no Accept header.
_SHORT = {"json": JSON, **{writer.suffix: writer.media_types[0] for writer in _WRITERS.values()}}


@dataclass(frozen=True)
class _Range:
    """One media range of an Accept header with its weight."""

    main: str
    sub: str
    weight: float

    def specificity(self, main: str, sub: str) -> int:
        """How closely the range names a media type.

        0 means not at all, 1 by ``*/*``, 2 by the main type, and 3 fully.
        """
        if (self.main, self.sub) == (main, sub):
            return 3
        if (self.main, self.sub) == (main, "*"):
            return 2
        return int((self.main, self.sub) == ("*", "*"))


def _weight(parameters: list[str]) -> float:
    """The q-value. An invalid value counts as 0."""
    for parameter in parameters:
        name, _, value = parameter.partition("=")
        if name.strip().lower() == "q":
            text = value.strip()
            is_number = text.replace(".", "", 1).isdecimal() and text.isascii()
            return float(text) if is_number and float(text) <= 1 else 0.0
    return 1.0


def _ranges(accept: str) -> list[_Range]:
    ranges = []
    for entry in accept.split(","):
        media, *parameters = entry.split(";")
        main, slash, sub = media.strip().lower().partition("/")
        if slash:
            ranges.append(_Range(main, sub, _weight(parameters)))
    return ranges


def _quality(media_type: str, ranges: list[_Range]) -> float:
    main, _, sub = media_type.partition("/")
    matching = [
        (entry.specificity(main, sub), entry.weight)
        for entry in ranges
        if entry.specificity(main, sub)
    ]
    return max(matching)[1] if matching else 0.0


def choose(accept: str | None) -> str:
    """Choose the media type of `ARRAYS` that the client prefers. On a tie, the first one wins.

    Raises
    ------
    NotAcceptableError
        If the client accepts none of them.
    """
    if accept is None or not accept.strip():
        return ARRAYS[0]
    ranges = _ranges(accept)
    best = max(ARRAYS, key=lambda media_type: _quality(media_type, ranges))
    if _quality(best, ranges) <= 0:
        raise NotAcceptableError(ARRAYS)
    return best


async def _media_type(
    request: Request,
    accept: Annotated[
        str | None, Header(description=f"One of {', '.join(ARRAYS)}; JSON by default.")
    ] = None,
    short: Annotated[
        str | None,
        Query(
            alias="format",
            pattern=f"^({'|'.join(_SHORT)})$",
            description="The same in a link; it goes first.",
        ),
    ] = None,
) -> AsyncIterator[str]:
    media_type = choose(accept) if short is None else _SHORT[short]
    async with render_slot(request):
        yield media_type


MediaType = Annotated[str, Depends(_media_type, scope="function")]
"""The media type of the response, and the slot for making it.

Maps are expensive, so cheap requests must not wait for them. The slot is free again before the
response is sent, so that a slow reader does not block others.
"""


def json_answer(model: BaseModel, **arrays: Any) -> Response:
    """Response with a model and additional ``arrays``, which Pydantic does not validate.

    Each number has the digits of its precision: a float32 that is read back is the same bit by bit.
    Values that are not finite become null.
    """
    plain = {
        name: None if array is None else np.asarray(array, order="C")
        for name, array in arrays.items()
    }
    document = {**model.model_dump(mode="json"), **plain}
    # orjson cannot serialize a zero-dimensional array.
    content = orjson.dumps(document, np.ndarray.tolist, orjson.OPT_SERIALIZE_NUMPY)
    return Response(content, media_type=JSON, headers={"Vary": "Accept"})


def file_answer(content: bytes, media_type: str, name: str) -> Response:
    """Response with a file that a browser shows, and its file name for saving."""
    headers = {"Vary": "Accept", "Content-Disposition": f'inline; filename="{name}"'}
    return Response(content, media_type=media_type, headers=headers)


def maps_answer(maps: Maps, media_type: str) -> Response:
    """Maps as a file in one of the representations other than JSON."""
    chosen = _WRITERS[media_type]
    return file_answer(chosen.write(maps), media_type, f"{maps.name}.{chosen.suffix}")
