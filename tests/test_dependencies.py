"""What the packages import is what their installation brings."""

import ast
import re
import sys
import tomllib
from collections.abc import Iterator
from functools import lru_cache
from importlib.metadata import packages_distributions
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("heliotwin", "model", "service", "training", "migrations")

# An extra is imported where it may be missing: in a function, or under a `try`, by the packages
# that know of it.
GUARDED = {"otel": ("service",), "ray": ("service",), "training": ("training",)}


def _normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def _declared(requirements: list[str]) -> set[str]:
    return {_normal(re.split(r"[^\w.-]", requirement)[0]) for requirement in requirements}


def _project() -> dict[str, Any]:
    document: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))[
        "project"
    ]
    return document


def _imports(tree: ast.AST, at_top: bool = True) -> Iterator[tuple[str, bool]]:
    """Names of imported modules, and whether each is imported as soon as its file is."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.Import):
            yield from ((alias.name, at_top) for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            yield str(node.module), at_top
        inside = isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Try)
        yield from _imports(node, at_top and not inside)


def _foreign(package: str) -> Iterator[tuple[str, bool, Path]]:
    for path in sorted((ROOT / package).rglob("*.py")):
        for module, at_top in _imports(ast.parse(path.read_text(encoding="utf-8"))):
            if module.split(".")[0] not in (*sys.stdlib_module_names, *PACKAGES):
                yield module, at_top, path


_installed = lru_cache(packages_distributions)


def _distributions(module: str) -> set[str]:
    """The distributions that hold this module; of a namespace, as opentelemetry's, those that hold
    the part.
    """
    found = {_normal(name) for name in _installed().get(module.split(".")[0], ())}
    part = _normal("-".join(module.split(".")[:2]))
    return found if len(found) == 1 else {name for name in found if name.startswith(part)}


@pytest.mark.parametrize("package", PACKAGES)
def test_every_import_is_declared(package: str):
    project = _project()
    always = _declared(project["dependencies"])
    extras = {name: _declared(project["optional-dependencies"][name]) for name in GUARDED}
    allowed = set().union(
        *(extras[name] for name, packages in GUARDED.items() if package in packages)
    )
    for module, at_top, path in _foreign(package):
        names = _distributions(module)
        assert names, f"{path}: {module} is not installed; make install"
        if names & always:
            continue
        assert names & allowed, f"{path}: {module} is declared nowhere"
        assert not at_top or package == "training", (
            f"{path}: {module} is of an extra, and imported without a guard"
        )


def test_every_dependency_has_an_upper_bound():
    project = _project()
    extras = [
        requirement for names in project["optional-dependencies"].values() for requirement in names
    ]
    for requirement in (*project["dependencies"], *extras):
        assert re.search(r"<\d|==", requirement) or requirement.startswith("heliotwin["), (
            requirement
        )
