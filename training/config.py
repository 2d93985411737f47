"""What decides a training run."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from model.network.architecture import NetworkConfig
from model.network.catalogue import NETWORKS, sizes_of
from training.render import Camera, Situations
from training.surfaces import Augmentation, fold_of, split


@dataclass(frozen=True)
class TrainConfig:
    """Everything that decides a run; stored beside its result.

    ``architecture`` is a name of `model.network.catalogue`, and ``network`` has its sizes. ``looks`` is how often the
    network sees its own guess. ``bfloat16`` computes with sixteen bits, where the machine is able to.
    ``learns_from`` are parts of `training.surfaces.SPLIT`; where ``folds`` are counted, the network learns from all
    heliostats but those of one ``fold``. ``batch`` is shared among processes.
    """

    data: str = "../shared/stj"
    seed: int = 7
    learns_from: tuple[str, ...] = ("training",)
    folds: int = 0
    fold: int = 0
    steps: int = 20000
    batch: int = 16
    learning_rate: float = 5e-4
    warmup: int = 100
    weight_decay: float = 0.02
    slope_weight: float = 0.5
    spread_weight: float = 0.1
    ema: float = 0.999
    bfloat16: bool = True
    looks: int = 2
    architecture: str = "ours"
    network: Any = field(default_factory=NetworkConfig)
    augmentation: Augmentation = field(default_factory=Augmentation)
    situations: Situations = field(default_factory=Situations)
    camera: Camera = field(default_factory=Camera)

    def parts(self, names: Sequence[str]) -> tuple[list[int], list[int]]:
        """Indices of the heliostats in ``names`` to learn from, and of those that judge while it learns, if any."""
        if self.folds:
            return fold_of(names, self.fold, self.folds)
        parts = split(names)
        judges = [] if "validation" in self.learns_from else parts["validation"]
        return sorted(i for part in self.learns_from for i in parts[part]), judges

    @classmethod
    def read(cls, path: Path) -> "TrainConfig":
        """A config from JSON; keys that are left out keep their defaults.

        Another network may be named by its sizes alone, as in ``{"ours": {}}``.
        """
        values = json.loads(path.read_text(encoding="utf-8"))
        for name in NETWORKS:
            sizes = values.pop(name, None)
            if sizes is not None:
                values |= {"architecture": name, "network": sizes}
        if "network" in values:
            values["network"] = sizes_of(values.get("architecture", cls.architecture), values["network"])
        for name, part in {"augmentation": Augmentation, "situations": Situations, "camera": Camera}.items():
            if values.get(name) is not None:
                values[name] = part(**{k: tuple(v) if isinstance(v, list) else v for k, v in values[name].items()})
        if "learns_from" in values:
            values["learns_from"] = tuple(values["learns_from"])
        return cls(**values)
