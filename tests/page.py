"""Pages by their elements, as their readers see them: no test searches markup by patterns."""

import re
from dataclasses import dataclass, field
from functools import cached_property
from html.parser import HTMLParser
from typing import Self

LINKS = ["href", "src", "action", "hx-get", "hx-post", "sse-connect", "data", "poster", "srcset"]
"""Attributes that name what a browser loads or follows."""
_VOID = frozenset(
    ["area", "base", "br", "col", "embed", "hr", "img", "input", "link", "meta", "source", "track"]
)


@dataclass(eq=False)
class Element:
    """An element with its attributes, and what is in it."""

    tag: str
    attributes: dict[str, str] = field(default_factory=dict)
    content: list[Self | str] = field(default_factory=list)
    parent: Self | None = None

    def __getitem__(self, name: str) -> str:
        return self.attributes[name]

    @property
    def words(self) -> str:
        """Its text; blanks and ends of lines are one blank."""
        return re.sub(r"[ \t\n]+", " ", self._text()).strip()

    def _text(self) -> str:
        return "".join(one if isinstance(one, str) else one._text() for one in self.content)

    def all(self, tag: str = "*", **attributes: str | bool) -> list[Self]:
        """The elements in it with these attributes, in order.

        True means that the attribute is there. ``class_`` is one of the element's classes. An
        underscore means a hyphen: ``aria_label``.
        """
        found = []
        for one in self.content:
            if not isinstance(one, str):
                found += [one] if one._is(tag, attributes) else []
                found += one.all(tag, **attributes)
        return found

    def one(self, tag: str = "*", **attributes: str | bool) -> Self:
        """The only such element."""
        found = self.all(tag, **attributes)
        assert len(found) == 1, f"{len(found)} of {tag} {attributes}"
        return found[0]

    def _is(self, tag: str, attributes: dict[str, str | bool]) -> bool:
        return tag in ("*", self.tag) and all(
            self._has(name.rstrip("_").replace("_", "-"), value)
            for name, value in attributes.items()
        )

    def _has(self, name: str, value: str | bool) -> bool:
        if isinstance(value, bool):
            return (name in self.attributes) == value
        if name == "class":
            return value in self.attributes.get(name, "").split()
        return self.attributes.get(name) == value


_INLINE = frozenset(
    ["a", "b", "code", "em", "i", "kbd", "label", "option", "small", "span", "strong"]
    + ["sub", "sup", "td", "th", "time"]
)
_UNSEEN = frozenset(["script", "style", "template"])
_CONTROLS = frozenset(["button", "input", "meter", "progress", "select", "textarea"])
_STATES = ("checked", "selected", "disabled", "required", "open", "hidden")


def lines_of(element: Element) -> list[str]:
    """What an element shows, a line for each block and row; links and controls in brackets."""
    lines = [""]
    for one in element.content:
        if isinstance(one, str):
            lines[-1] += re.sub(r"[ \t\n]+", " ", one)
        elif one.tag in ("svg", "img", "canvas"):
            label = one.attributes.get("aria-label") or one.attributes.get("alt", "")
            lines[-1] += f"[{one.tag} {label}]"
        elif one.tag not in _UNSEEN:
            first, *more = lines_of(one)
            if one.tag in _INLINE | _CONTROLS:
                lines[-1] += first + _brackets(one) + (" | " if one.tag in ("td", "th") else "")
                lines += more
            else:
                lines += [_brackets(one) + first, *more, ""]
    return [line for line in map(str.rstrip, lines[:-1]) if line.strip()] + lines[-1:]


def _brackets(one: Element) -> str:
    """A link's address; a control's kind, name, value and state."""
    if one.tag == "a":
        return f"[{one.attributes.get('href', '')}]"
    states = [name for name in _STATES if name in one.attributes]
    if one.tag in _CONTROLS | {"option", "form"}:
        given = (one.attributes.get(name, "") for name in ("type", "action", "name", "value"))
        return f"[{' '.join([one.tag, *filter(None, given), *states])}]"
    return f"[{' '.join(states)}]" if states else ""


class Page(str):
    """The markup of a page, and its elements."""

    @cached_property
    def root(self) -> Element:
        """What holds all elements."""
        parser = _Parser()
        parser.feed(self)
        parser.close()
        return parser.root

    @property
    def words(self) -> str:
        """Its text."""
        return self.root.words

    def all(self, tag: str = "*", **attributes: str | bool) -> list[Element]:
        """`Element.all` of the whole page."""
        return self.root.all(tag, **attributes)

    def one(self, tag: str = "*", **attributes: str | bool) -> Element:
        """`Element.one` of the whole page."""
        return self.root.one(tag, **attributes)

    @property
    def links(self) -> list[str]:
        """What a browser would load or follow."""
        return [one[name] for one in self.all() for name in LINKS if name in one.attributes]

    def texts(self, tag: str = "*", **attributes: str | bool) -> list[str]:
        """The texts of such elements."""
        return [one.words for one in self.all(tag, **attributes)]

    def cells(self, heading: str) -> list[str]:
        """The texts of the cells in the row of a table that begins with ``heading``."""
        (row,) = [
            row
            for row in self.all("tr")
            if heading in [one.words for one in row.all("th", scope="row")]
        ]
        return [one.words for one in row.all("td")]


class _Parser(HTMLParser):
    """Builds the tree of `Element`."""

    def __init__(self) -> None:
        super().__init__()
        self.root = self._open = Element("")

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_startendtag(tag, attrs)
        if tag not in _VOID:
            child = self._open.content[-1]
            assert isinstance(child, Element)
            self._open = child

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value or "" for name, value in attrs}
        self._open.content.append(Element(tag, given, parent=self._open))

    def handle_endtag(self, tag: str) -> None:
        is_open = self._open
        while is_open.parent is not None and is_open.tag != tag:
            is_open = is_open.parent
        if is_open.parent is not None:
            self._open = is_open.parent

    def handle_data(self, data: str) -> None:
        self._open.content.append(data)
