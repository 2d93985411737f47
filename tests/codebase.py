"""Counts of what makes the code hard to read: ``python -m tests.codebase``.

``--check`` fails if a count exceeds its limit (`LIMITS`); ``--all`` lists the places.
"""

import ast
import re
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGES = ("model", "service", "training", "heliotwin", "migrations")
MAX_PARAMETERS = 7
MAX_CLASS_LINES = 150

TEXTS = (
    "*.py",
    "*.html",
    "*.js",
    "*.css",
    "*.md",
    "*.yml",
    "*.yaml",
    "*.toml",
    "Makefile",
    "Dockerfile",
)
WORDS = {
    "told, tells": r"\b(?:told|tells?)\b",
    "stands, stood": r"\b(?:stands|stood)\b",
    "set aside": r"\bset[ _]aside\b",
    "anew": r"\banew\b",
    "doubt": r"\bdoubt(?:s|ed|ful)?\b",
    "today's": r"\btoday's\b",
    "given up": r"\bg(?:iven|ive|ives|iving|ave)[ _](?:up|way)\b",
    "worked out": r"\bwork(?:ed|s)? (?:it |them )?out\b",
    "whoever, whither": r"\b(?:whoever|whither|whence|thereof)\b",
    "of its own": r"\bof (?:its|their|our|his) own\b",
    "held against": r"\bh[eo]ld(?:s)? against\b",
    "Book, Gate, Shot, Deed": (
        r"(?-i:\b(?<!NURBS )(?:\w*Book|Gate|Turns|Shots?|Wanted|Shown)\b)|\bdeeds?\b"
    ),
    "room, house": r"\b(?:rooms?|houses?)\b",
    "strangeness": r"\bstrangeness\b",
    "believe": r"\bbelie(?:ve|ves|ved|f)\b",
}
"""Words of WORDS.md's left column, each with the pattern that finds it."""


@dataclass(frozen=True)
class Definition:
    """A class or function: where it is, its name and its syntax tree."""

    path: str
    node: ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef

    @property
    def place(self) -> str:
        """``path:line name``."""
        return f"{self.path}:{self.node.lineno} {self.node.name}"


def python_files(packages: tuple[str, ...] = PACKAGES) -> list[Path]:
    """The Python files of the packages, in order."""
    return sorted(path for package in packages for path in (ROOT / package).rglob("*.py"))


@cache
def definitions() -> tuple[Definition, ...]:
    """All classes and functions of the product."""
    found = []
    for path in python_files():
        tree = ast.parse(path.read_text())
        kinds = (ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
        where = path.relative_to(ROOT).as_posix()
        found += [Definition(where, node) for node in ast.walk(tree) if isinstance(node, kinds)]
    return tuple(found)


def lines_of_code() -> int:
    """Lines of Python in the product with code: no docstrings, comments and blank lines."""
    return sum(map(_code_lines, python_files()))


def _code_lines(path: Path) -> int:
    text = path.read_text()
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    docstrings = {
        line
        for node in ast.walk(ast.parse(text))
        if isinstance(node, documented) and ast.get_docstring(node) is not None
        for line in range(node.body[0].lineno, node.body[0].end_lineno + 1)
    }
    lines = enumerate(text.splitlines(), start=1)
    return sum(
        number not in docstrings and bool(line.strip()) and not line.lstrip().startswith("#")
        for number, line in lines
    )


def old_words() -> Counter[str]:
    """How often each word that WORDS.md replaces occurs in code, pages and documents."""
    counts: Counter[str] = Counter()
    for text in texts():
        for word, pattern in WORDS.items():
            counts[word] += len(re.findall(pattern, text, re.IGNORECASE))
    return counts


def texts() -> Iterator[str]:
    """Code, pages and documents that people read."""
    folders = [ROOT / name for name in (*PACKAGES, "tests", "benchmarks", "docker", "docs")]
    paths = {path for folder in folders for pattern in TEXTS for path in folder.rglob(pattern)}
    paths |= {ROOT / name for name in ("README.md", "RESULTS.md", "Makefile")}
    for path in sorted(paths - {Path(__file__)}):
        is_built = not {"generated", "guide"}.isdisjoint(path.parts)
        if ".min." not in path.name and not is_built:
            yield path.read_text()


def repeated_classes() -> dict[str, list[str]]:
    """Names of classes that occur more than once in the product."""
    places: dict[str, list[str]] = {}
    for definition in definitions():
        if isinstance(definition.node, ast.ClassDef):
            places.setdefault(definition.node.name, []).append(definition.place)
    return {name: found for name, found in places.items() if len(found) > 1}


REQUEST_CLASSES = ("ForecastBase", "ForecastIn", "Setup")
"""What a forecast request is on its way from the REST schema to the tracer."""


def request_names() -> set[str]:
    """Names of the fields of a forecast request, from the REST schema to the tracer."""
    return {
        ast.unparse(line.target)
        for definition in definitions()
        if isinstance(definition.node, ast.ClassDef) and definition.node.name in REQUEST_CLASSES
        for line in definition.node.body
        if isinstance(line, ast.AnnAssign)
    }


def long_classes() -> list[str]:
    """Classes with more lines than `MAX_CLASS_LINES`."""
    return [
        f"{d.place} {_lines(d.node)}"
        for d in definitions()
        if isinstance(d.node, ast.ClassDef) and _lines(d.node) > MAX_CLASS_LINES
    ]


def wide_functions() -> list[str]:
    """Functions with more parameters than `MAX_PARAMETERS`, but for verbs and routes, which declare
    options.
    """
    return [
        f"{d.place} {_parameters(d.node)}"
        for d in _functions()
        if _parameters(d.node) > MAX_PARAMETERS
    ]


def tuple_functions() -> list[str]:
    """Functions and methods that are annotated to return a tuple, of any length."""
    return [
        d.place
        for d in definitions()
        if not isinstance(d.node, ast.ClassDef)
        and d.node.returns is not None
        and ast.unparse(d.node.returns).startswith("tuple[")
    ]


def page_routes_with_store() -> list[str]:
    """Routes of pages that use the store, and do not ask a function of their resource."""
    found = []
    for path in (ROOT / "service" / "web").rglob("*.py"):
        tree = ast.parse(path.read_text())
        imported = [node for node in tree.body if isinstance(node, ast.ImportFrom)]
        of_store = {
            alias.asname or alias.name
            for node in imported
            for alias in node.names
            if f"{node.module}.{alias.name}".startswith("service.store")
        } | {"Session", "reading"}
        for node in tree.body:
            if isinstance(node, ast.FunctionDef) and _is_page(node, path):
                names = {ast.unparse(inner) for line in node.body for inner in ast.walk(line)}
                attributes = {name.rpartition(".")[2] for name in names}
                if of_store & (names | attributes):
                    found.append(f"{path.relative_to(ROOT).as_posix()}:{node.lineno} {node.name}")
    return found


def _is_page(node: ast.FunctionDef, path: Path) -> bool:
    routes = ("pages.", "router.") if path.parent.name == "pages" else ("pages.",)
    return any(ast.unparse(one).startswith(routes) for one in node.decorator_list)


def lines_with(word: str) -> int:
    """Lines of the product that name ``word``."""
    return sum(word in line for path in python_files() for line in path.read_text().splitlines())


def _functions() -> Iterator[Definition]:
    for definition in definitions():
        is_endpoint = definition.path.startswith(
            ("heliotwin/cli/verbs/", "service/web/pages/", "service/web/resources/")
        )
        if not isinstance(definition.node, ast.ClassDef) and not (
            is_endpoint and definition.node.decorator_list
        ):
            yield definition


def _lines(node: ast.stmt) -> int:
    return (node.end_lineno or node.lineno) - node.lineno + 1


def _parameters(node: ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    assert not isinstance(node, ast.ClassDef)
    names = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
    return sum(argument.arg not in ("self", "cls") for argument in names)


LIMITS = {
    "lines of code": 55361,
    "words that WORDS.md replaces": 0,
    "names of two or more classes": 0,
    f"functions above {MAX_PARAMETERS} parameters": 0,
    "functions annotated -> tuple[..]": 49,
    f"classes above {MAX_CLASS_LINES} lines": 1,
    "lines with latitude_deg": 18,
    "names of a forecast request's fields": 23,
    "files in service": 200,
    "dict[str, Any] in service": 39,
    "page routes that use the store": 0,
}
"""The most of each count. A limit is lowered when its count falls; it rises with a feature only."""


def count_all() -> dict[str, int]:
    """Return each count of `LIMITS`."""
    found = (
        lines_of_code(),
        old_words().total(),
        len(repeated_classes()),
        len(wide_functions()),
        len(tuple_functions()),
        len(long_classes()),
        lines_with("latitude_deg"),
        len(request_names()),
        len(python_files(("service",))),
        sum(path.read_text().count("dict[str, Any]") for path in python_files(("service",))),
        len(page_routes_with_store()),
    )
    return dict(zip(LIMITS, found, strict=True))


def check() -> None:
    """Exit with an error that names each count above its limit."""
    counts = count_all()
    exceeded = [
        f"{name}: {counts[name]}, at most {limit}"
        for name, limit in LIMITS.items()
        if counts[name] > limit
    ]
    if exceeded:
        sys.exit("\n".join([*exceeded, "python -m tests.codebase --all lists the places"]))


def details() -> str:
    """What is behind the counts, one place a line."""
    blocks = {
        "words": [f"{word}: {count}" for word, count in old_words().most_common()],
        "repeated classes": [
            f"{name}: {', '.join(places)}" for name, places in repeated_classes().items()
        ],
        "wide functions": wide_functions(),
        "long classes": long_classes(),
        "functions that return tuples": tuple_functions(),
        "page routes that use the store": page_routes_with_store(),
    }
    return "\n\n".join("\n".join([f"# {name}", *lines]) for name, lines in blocks.items())


if __name__ == "__main__":
    for count_name, count in count_all().items():
        sys.stdout.write(f"{count:>7,}  {count_name}\n")
    if "--check" in sys.argv:
        check()
    if "--all" in sys.argv:
        sys.stdout.write("\n" + details() + "\n")
