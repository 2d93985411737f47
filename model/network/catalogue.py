"""The networks that a training may have, by name."""

from collections.abc import Mapping
from importlib import import_module
from types import ModuleType
from typing import Any

from torch import nn

from model.errors import InvalidInputError

NETWORKS = {
    "ours": "architecture",
}
"""The name in a training's config, and the file of this package, with its `SIZES` and `NETWORK`."""


def _module(name: str) -> ModuleType:
    if name not in NETWORKS:
        raise InvalidInputError(f"'architecture' {name!r} is unknown; it must be one of {', '.join(NETWORKS)}")
    return import_module(f"model.network.{NETWORKS[name]}")


def sizes_of(name: str, values: Mapping[str, Any]) -> Any:
    """The sizes of a network, a dataclass of its own, of JSON; those that are left out keep their defaults."""
    sizes = _module(name).SIZES
    return sizes(**{key: tuple(value) if isinstance(value, list) else value for key, value in values.items()})


def build(name: str, sizes: Any) -> nn.Module:
    """A network with random weights, with the call of `model.network.architecture.SurfaceNetwork`."""
    network: nn.Module = _module(name).NETWORK(sizes)
    return network
