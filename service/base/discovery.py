"""Discovery of modules: a new resource, page, job kind or command group needs only a new file."""

import pkgutil
from importlib import import_module
from types import ModuleType


def modules_of(package: str) -> list[ModuleType]:
    """Import all modules of a package, sorted by name."""
    path = import_module(package).__path__
    return [
        import_module(f"{package}.{found.name}")
        for found in sorted(pkgutil.iter_modules(path), key=_name)
    ]


def _name(found: pkgutil.ModuleInfo) -> str:
    return found.name
