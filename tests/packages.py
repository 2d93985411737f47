"""The packages and their imports, read from the code: ``python -m tests.packages``.

It prints the table of docs/explanation/architecture.md. A test checks that the page has it.
"""

import importlib
import sys
from pathlib import Path

import grimp

ROOT = Path(__file__).parents[1]

PACKAGES = (
    *(
        "model.sunshape",
        "model.imaging",
        "model.network",
        "model.tracing",
        "model.effects",
        "model.study",
    ),
    *(f"service.{name}" for name in ("base", "drawing", "sources", "store", "twin", "jobs", "web")),
    "training",
    "heliotwin",
    "heliotwin.cli",
)
"""The packages of the table, in the order in which they build on each other."""


def purpose(package: str) -> str:
    """Purpose of a package: the first paragraph of its docstring."""
    text = importlib.import_module(package).__doc__ or ""
    return " ".join(text.partition("\n\n")[0].split())


def package_imports() -> dict[str, list[str]]:
    """The packages that each package imports directly.

    Imports from another top-level package are listed under its name, for example ``model``.
    """
    graph = grimp.build_graph("model", "training", "service", "heliotwin", cache_dir=None)
    found: dict[str, list[str]] = {}
    for package in PACKAGES:
        inside = {package, *graph.find_descendants(package)}
        imported = {
            name for module in inside for name in graph.find_modules_directly_imported_by(module)
        }
        owner = package.partition(".")[0]
        near = [
            other
            for other in PACKAGES
            if other != package
            and other.startswith(f"{owner}.")
            and any(_is_in(name, other) for name in imported)
        ]
        far = [
            name
            for name in ("model", "service", "training", "heliotwin")
            if name != owner and any(_is_in(i, name) for i in imported)
        ]
        found[package] = [*far, *(other.removeprefix(f"{owner}.") for other in near)]
    return found


def _is_in(module: str, package: str) -> bool:
    return module == package or module.startswith(f"{package}.")


def table() -> str:
    """A Markdown table: package, its purpose, its imports."""
    lines = ["| package | what it is for | imports |", "| --- | --- | --- |"]
    for package, imported in package_imports().items():
        lines.append(
            f"| `{package.replace('.', '/')}` | {purpose(package)} | {', '.join(imported) or '-'} |"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    sys.stdout.write(table() + "\n")
