"""Sentences of the documentation and their statistics: ``python -m tests.documents.prose``.

Prose, list items and cells of tables count; code, headings and generated pages do not.
"""

import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
MIN_CELL_WORDS = 4
"""Cells of tables with fewer words are entries, not sentences."""

_FENCE = re.compile(r"^(?P<indent> *)(?P<marks>`{3,}|:{3,}|\${2}|~{3,}).*$")
_INLINE_CODE = re.compile(r"`+[^`]+`+")
_LINK = re.compile(r"!?\[([^\]]*)\]\([^)]*\)")
_ROLE = re.compile(r"\{[a-z:]+\}(?=code)")
_END = re.compile(r"(?<=[.!?])[\"')\]*]*\s+(?=[\"'(\[*]*[A-Z0-9]|code\b)")
_ABBREVIATIONS = re.compile(r"\b(e\.g|i\.e|et al|vs|approx|No|Fig)\.")


def pages() -> list[Path]:
    """README and the pages of the site that a person wrote."""
    written = (path for path in DOCS.rglob("*.md") if "generated" not in path.parts)
    return [ROOT / "README.md", *sorted(written)]


def sentences(text: str) -> list[str]:
    """The sentences of a page, with inline code as one word each."""
    return [
        sentence
        for block in _blocks(text)
        for sentence in _END.split(_plain(block))
        if re.search(r"[A-Za-z]{2}", sentence)
    ]


def _plain(block: str) -> str:
    text = _INLINE_CODE.sub("code", block)
    text = _ROLE.sub("", _LINK.sub(r"\1", text))
    text = _ABBREVIATIONS.sub(r"\1", re.sub(r"<[^>]+>|\$[^$]+\$", " x ", text))
    return " ".join(text.replace("**", "").split())


def _blocks(text: str) -> Iterator[str]:
    """Paragraphs, list items and cells of a page."""
    fence, block = "", []
    for line in [*text.splitlines(), ""]:
        stripped = line.strip()
        mark = _FENCE.match(line)
        if fence:
            fence = "" if stripped.startswith(fence) and not stripped.strip(fence[0]) else fence
            continue
        is_admonition = stripped.startswith(":::")
        if mark and not is_admonition:
            fence = "" if stripped.endswith("$$") and len(stripped) > 4 else mark["marks"]
        starts_anew = re.match(r"([-*+]|\d+\.)\s", stripped)
        is_break = not stripped or mark or stripped.startswith(("#", "|", "{", "(", "<!--", ":"))
        if block and (is_break or starts_anew):
            yield " ".join(block)
            block = []
        if stripped.startswith("|") and not set(stripped) <= set("|-: "):
            cells = re.split(r"(?<!\\)\|", stripped.strip("|"))
            yield from (cell for cell in cells if len(_plain(cell).split()) >= MIN_CELL_WORDS)
        elif not is_break or (stripped.startswith("(") and not stripped.endswith(")=")):
            block.append(re.sub(r"^([-*+]|\d+\.)\s+", "", stripped))


@dataclass(frozen=True)
class Statistics:
    """Lengths [words] of sentences, and how many hold a semicolon."""

    lengths: tuple[int, ...]
    semicolons: int

    @property
    def mean(self) -> float:
        """Mean length."""
        return sum(self.lengths) / len(self.lengths)

    @property
    def ninetieth(self) -> int:
        """The length that 90 % of the sentences do not exceed."""
        return sorted(self.lengths)[int(0.9 * (len(self.lengths) - 1))]

    @property
    def long_share(self) -> float:
        """Share of sentences above 25 words."""
        return sum(length > 25 for length in self.lengths) / len(self.lengths)

    @property
    def semicolon_share(self) -> float:
        """Share of sentences with a semicolon."""
        return self.semicolons / len(self.lengths)

    def faults(self) -> list[str]:
        """What exceeds its limit."""
        measured = {
            "mean length": (self.mean, 16.0),
            "length of 90 %": (self.ninetieth, 27.0),
            "share above 25 words": (self.long_share, 0.10),
            "share with a semicolon": (self.semicolon_share, 0.06),
        }
        return [
            f"{name}: {value:.2f}, at most {limit:g}"
            for name, (value, limit) in measured.items()
            if value > limit
        ]


def statistics_of(texts: list[str]) -> Statistics:
    """Statistics of all sentences in these pages."""
    found = [sentence for text in texts for sentence in sentences(text)]
    return Statistics(tuple(len(s.split()) for s in found), sum(";" in s for s in found))


if __name__ == "__main__":
    for page in pages():
        text = page.read_text(encoding="utf-8")
        if sentences(text):
            found = statistics_of([text])
            sys.stdout.write(
                f"{len(found.lengths):5} {found.mean:5.1f} {found.ninetieth:4}"
                f" {found.long_share:6.0%} {found.semicolon_share:5.0%} "
                f" {page.relative_to(ROOT)}\n"
            )
            if "--long" in sys.argv:
                for sentence in sentences(text):
                    if len(sentence.split()) > 25 or ";" in sentence:
                        sys.stdout.write(f"      {len(sentence.split())}: {sentence}\n")
