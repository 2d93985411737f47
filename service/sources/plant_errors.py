"""Mistakes in ``plant.yaml``, each in one line: file, line, key path, and what to do."""

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, get_args

from pydantic import ValidationError

from model.errors import InvalidInputError, ModelError
from service.base.validation import message_of
from service.sources.plant_schema import (
    Drive,
    KeyMistakeError,
    PlantDocument,
    ReceiverEntry,
    SunEntry,
    nearest,
)
from service.sources.text_lines import KeyPath, YamlDocument, read_yaml

# Forms of a value besides its words, for the message of a word that is none of them.
_OTHER_FORMS = {
    "facet_shape": "{focal_length_m: ..}",
    "canting": "{focal_length_m: ..}, {off_axis: {azimuth_deg: .., elevation_deg: ..}}",
}

_MESSAGES: Mapping[str, str] = {
    "missing": "is missing; add it",
    "string_type": "must be text",
    **dict.fromkeys(("float_type", "int_type"), "must be a number"),
    "list_type": "must be a list, [..]",
    "tuple_type": "must be a list, [..]",
    "dict_type": "must be lines of key: value",
    "model_type": "must be lines of key: value",
    "model_attributes_type": "must be lines of key: value",
}


_MOST_MISTAKES = 50


class Mistakes:
    """Collects mistakes, to name all of them in one error."""

    def __init__(self) -> None:
        self.found: list[str] = []

    @contextmanager
    def collected(self) -> Iterator[None]:
        """Keep an error of the block for `require_none`."""
        try:
            yield
        except InvalidInputError as error:
            self.found.append(str(error))

    def require_none(self) -> None:
        """Raise InvalidInputError with all mistakes, one a line."""
        if self.found:
            lines = [line for mistake in self.found for line in mistake.split("\n")]
            files = list(dict.fromkeys(map(_file_of, lines)))
            lines.sort(key=lambda line: (files.index(_file_of(line)), _number_of(line)))
            more = len(lines) - _MOST_MISTAKES
            rest = [f"and {more} more"] if more > 0 else []
            raise InvalidInputError("\n".join([*lines[:_MOST_MISTAKES], *rest]))


def _file_of(mistake: str) -> str:
    return re.split(", line |:", mistake, maxsplit=1)[0]


def _number_of(mistake: str) -> int:
    found = re.match(r".*?, line (\d+)", mistake)
    return int(found[1]) if found else 0


def parse_plant(document: YamlDocument) -> PlantDocument:
    """Validate a plant; InvalidInputError names the line and key of each mistake."""
    try:
        return PlantDocument.model_validate(document.value)
    except ValidationError as error:
        mistakes = Mistakes()
        by_path = {_path(document, entry): entry for entry in error.errors(include_url=False)[::-1]}
        of_wrong_kind = {path[:-1] for path in by_path if path[-1:] == ("kind",)}
        paths = [p for p in by_path if p[-1:] == ("kind",) or p[:-1] not in of_wrong_kind]
        for path in sorted(paths, key=partial(_line, document)):
            mistakes.found.append(f"{document.place(path)}: {_message(by_path[path], path)}")
        mistakes.require_none()
        raise


@dataclass(frozen=True)
class PlantText:
    """A plant's file: its folder, its text with line numbers, and its validated entries."""

    folder: Path
    document: YamlDocument
    entries: PlantDocument

    @classmethod
    def read(cls, path: Path) -> "PlantText":
        """Read and validate the file.

        Raises
        ------
        InvalidInputError
            It names file, line and key path of each mistake.
        """
        document = read_yaml(path)
        return cls(path.parent, document, parse_plant(document))

    def place(self, *path: str | int) -> str:
        """File, line and key path of a value, as messages begin."""
        return self.document.place(path)

    def file(self, name: str, *path: str | int) -> Path:
        """A file that the document names, within its folder."""
        return named_file(self.folder, self.document, name, *path)


def named_file(folder: Path, document: YamlDocument, name: str, *path: str | int) -> Path:
    """A file that a document of ``folder`` names at ``path``, within the folder."""
    file, place = folder / name, document.place(path)
    try:
        is_inside = file.resolve().is_relative_to(folder.resolve())
    except (OSError, RuntimeError):
        is_inside = False
    if Path(name).is_absolute() or not is_inside:
        raise InvalidInputError(
            f"{place}: {name[:60]!r} leads outside of the folder of plant.yaml; copy the file into"
            " it"
        )
    if not file.exists():
        raise InvalidInputError(f"{place}: no such file as {name[:60]!r} beside plant.yaml")
    return file


@contextmanager
def mistakes_at(place: str) -> Iterator[None]:
    """Prefix an error of the model with the place in the file that it comes from."""
    try:
        yield
    except ModelError as error:
        raise InvalidInputError(f"{place}: {error}") from None


def _line(document: YamlDocument, path: KeyPath) -> int:
    while path not in document.lines:
        path = path[:-1]
    return document.lines[path]


def _path(document: YamlDocument, entry: Mapping[str, Any]) -> KeyPath:
    """The path of an error: its location without the variants of unions."""
    path: KeyPath = ()
    for part in entry["loc"]:
        if (*path, part) in document.lines:
            path = (*path, part)
    kind, context = entry["type"], entry.get("ctx", {})
    if kind == "missing":
        return (*path, entry["loc"][-1])
    if isinstance(mistake := context.get("error"), KeyMistakeError):
        return (*path, mistake.key)
    if kind in ("union_tag_invalid", "union_tag_not_found"):
        return (*path, context["discriminator"].strip("'"))
    return path


def _message(entry: Mapping[str, Any], path: KeyPath) -> str:
    kind, context, value = entry["type"], entry.get("ctx", {}), entry["input"]
    if isinstance(mistake := context.get("error"), KeyMistakeError):
        return mistake.message  # its key is in the path
    if kind in ("literal_error", "union_tag_invalid"):
        expected = context.get("expected_tags", context.get("expected", ""))
        known = expected.replace(" or ", ", ").replace("'", "").split(", ")
        if (path[0], path[-1], context.get("tag", value)) == ("targets", "kind", "cylinder"):
            return (
                "'cylinder' is no target: photographs are measured on planes. Put it into"
                " receivers; heliostats aim at those too"
            )
        return _none_of(context.get("tag", value), known, _OTHER_FORMS.get(str(path[-1])))
    if kind == "union_tag_not_found":
        return f"is missing; add it, one of {_kinds(path)}"
    message = _MESSAGES.get(kind) or message_of(entry)
    is_scalar = isinstance(value, str | int | float) or value is None
    return f"{message}, got {_brief(value)}" if is_scalar and kind != "missing" else message


def _kinds(path: KeyPath) -> str:
    """The variants of the union that an object without its kind belongs to."""
    union = {"sun": SunEntry, "receivers": ReceiverEntry}.get(str(path[0]), Drive)
    key = str(path[-1])
    variants = get_args(get_args(union)[0])
    return ", ".join(get_args(variant.model_fields[key].annotation)[0] for variant in variants)


def _none_of(value: object, known: list[str], other: str | None) -> str:
    """The message of a word that is none of those known."""
    close = nearest(str(value), known)
    remedy = f"; {close}" if close.startswith("did") else ""
    forms = ", ".join([*known, other] if other else known)
    return f"{_brief(value)} is none of {forms}{remedy}"


def _brief(value: object) -> str:
    """A value of the file in a message."""
    if value is None:
        return "nothing"
    shown = str(value).lower() if isinstance(value, bool) else repr(value)
    return shown if len(shown) <= 60 else f"{shown[:60]}.."
