"""Representations: what is offered beside JSON, and which of them a client likes best."""

from collections.abc import AsyncIterator
from dataclasses import dataclass
from importlib import import_module
from typing import Annotated, Any

import numpy as np
import orjson
from fastapi import Depends, Header, Query, Request, Response
from pydantic import BaseModel

from service.base.faults import NotAcceptableError
from service.web.answers.representation import Maps, Representation
from service.web.door.dependencies import turn

JSON = "application/json"

OFFERED = (
    "npz",
    "png",
)
"""Other representations, where a client likes two alike the one that it gets first; files of `representations`."""

_WRITERS: dict[str, Representation] = {
    media_type: representation
    for name in OFFERED
    for representation in [import_module(f"service.web.answers.representations.{name}").REPRESENTATION]
    for media_type in representation.media_types
}

ARRAYS = (JSON, *_WRITERS)
"""What flux maps and surfaces are offered as, the default first."""

# Their short names, for links: a link bears no Accept.
_SHORT = {"json": JSON, **{writer.suffix: writer.media_types[0] for writer in _WRITERS.values()}}


@dataclass(frozen=True)
class _Range:
    """One media range of an Accept header with its weight."""

    main: str
    sub: str
    weight: float

    def specificity(self, main: str, sub: str) -> int:
        """How closely it names a media type: 0 not at all, 1 by ``*/*``, 2 by its main type, 3 fully."""
        if (self.main, self.sub) == (main, sub):
            return 3
        if (self.main, self.sub) == (main, "*"):
            return 2
        return int((self.main, self.sub) == ("*", "*"))


def _weight(parameters: list[str]) -> float:
    """The q-value; what is no number between 0 and 1 counts as 0, so that nonsense never wins."""
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
    matching = [(entry.specificity(main, sub), entry.weight) for entry in ranges if entry.specificity(main, sub)]
    return max(matching)[1] if matching else 0.0


def choose(accept: str | None, offered: tuple[str, ...] = ARRAYS) -> str:
    """The offered media type that the client likes best; ties go to the one offered first.

    Raises
    ------
    NotAcceptableError
        Where the client accepts none of them.
    """
    if accept is None or not accept.strip():
        return offered[0]
    ranges = _ranges(accept)
    best = max(offered, key=lambda media_type: _quality(media_type, ranges))
    if _quality(best, ranges) <= 0:
        raise NotAcceptableError(offered)
    return best


async def _media_type(
    request: Request,
    accept: Annotated[str | None, Header(description=f"One of {', '.join(ARRAYS)}; JSON by default.")] = None,
    short: Annotated[
        str | None,
        Query(alias="format", pattern=f"^({'|'.join(_SHORT)})$", description="The same in a link; it goes first."),
    ] = None,
) -> AsyncIterator[str]:
    media_type = choose(accept) if short is None else _SHORT[short]
    async with turn(request):
        yield media_type


MediaType = Annotated[str, Depends(_media_type, scope="function")]
"""What to answer with, and a turn at making it: maps are heavy, and what is light shall not wait for them. The turn
ends before the answer is sent, so that a slow reader keeps nobody waiting."""


def json_answer(model: BaseModel, **arrays: Any) -> Response:
    """A model with arrays beside it that are not worth checking number by number.

    Each number has the digits that its own precision needs: read back as float32, a float32 is the same, bit by bit.
    What is not finite becomes null.
    """
    plain = {name: None if array is None else np.asarray(array, order="C") for name, array in arrays.items()}
    document = {**model.model_dump(mode="json"), **plain}
    # An array without an axis is none to orjson.
    content = orjson.dumps(document, np.ndarray.tolist, orjson.OPT_SERIALIZE_NUMPY)
    return Response(content, media_type=JSON, headers={"Vary": "Accept"})


def file_answer(content: bytes, media_type: str, name: str) -> Response:
    """A file that a browser shows, under a name to keep it by."""
    headers = {"Vary": "Accept", "Content-Disposition": f'inline; filename="{name}"'}
    return Response(content, media_type=media_type, headers=headers)


def maps_answer(maps: Maps, media_type: str) -> Response:
    """Maps as a file of one of the representations beside JSON."""
    chosen = _WRITERS[media_type]
    return file_answer(chosen.write(maps), media_type, f"{maps.name}.{chosen.suffix}")
