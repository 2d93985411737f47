"""Finding modules: a resource, page, job kind or group of verbs is one new file, and stands in no list."""

import pkgutil
from importlib import import_module
from types import ModuleType


def modules_of(package: str) -> list[ModuleType]:
    """Every module of a package, imported, in the order of their names."""
    path = import_module(package).__path__
    return [import_module(f"{package}.{found.name}") for found in sorted(pkgutil.iter_modules(path), key=_name)]


def _name(found: pkgutil.ModuleInfo) -> str:
    return found.name
