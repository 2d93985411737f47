"""The rooms of the house and the arrows between them, read from the code: ``python -m tests.house``.

It prints the table that README shows; a test holds README to it.
"""

import importlib
import sys
from pathlib import Path

import grimp

ROOT = Path(__file__).parents[1]

ROOMS = (
    *("model.sunshape", "model.imaging", "model.network", "model.tracing", "model.effects", "model.study"),
    *(f"service.{room}" for room in ("base", "drawing", "sources", "store", "twin", "jobs", "web", "cli")),
    "training",
)
"""Those that the table shows, in the order in which they build on each other."""


def purpose(package: str) -> str:
    """What a room is for: the first paragraph of its docstring."""
    text = importlib.import_module(package).__doc__ or ""
    return " ".join(text.partition("\n\n")[0].split())


def arrows() -> dict[str, list[str]]:
    """The rooms that each room imports, directly; ``model`` stands for all of its rooms where another package asks."""
    graph = grimp.build_graph("model", "training", "service", cache_dir=None)
    found: dict[str, list[str]] = {}
    for room in ROOMS:
        inside = {room, *graph.find_descendants(room)}
        imported = {name for module in inside for name in graph.find_modules_directly_imported_by(module)}
        owner = room.partition(".")[0]
        near = [
            other
            for other in ROOMS
            if other != room and other.startswith(f"{owner}.") and any(_lies_in(name, other) for name in imported)
        ]
        far = [
            name
            for name in ("model", "service", "training")
            if name != owner and any(_lies_in(i, name) for i in imported)
        ]
        found[room] = [*far, *(other.removeprefix(f"{owner}.") for other in near)]
    return found


def _lies_in(module: str, package: str) -> bool:
    return module == package or module.startswith(f"{package}.")


def table() -> str:
    """A Markdown table: room, what it is for, what it imports."""
    lines = ["| room | what it is for | imports |", "| --- | --- | --- |"]
    for room, imported in arrows().items():
        lines.append(f"| `{room.replace('.', '/')}` | {purpose(room)} | {', '.join(imported) or '-'} |")
    return "\n".join(lines)


if __name__ == "__main__":
    sys.stdout.write(table() + "\n")
