"""The configuration of a training run."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from model.network.architecture import NetworkConfig
from training.render import RealCamera, SceneSampler
from training.surfaces import Augmentation, Partition, fold_of, split


@dataclass(frozen=True)
class TrainConfig:
    """All settings of a run; stored with its result.

    ``n_iterations`` is the number of times that the network is applied, each to its previous
    output. ``bfloat16`` computes with sixteen bits if the machine supports it. ``learns_from`` are
    parts of `training.surfaces.SPLIT`. With ``folds`` the network learns from all heliostats except
    those of one ``fold``.
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
    n_iterations: int = 2
    network: NetworkConfig = field(default_factory=NetworkConfig)
    augmentation: Augmentation = field(default_factory=Augmentation)
    scenes: SceneSampler = field(default_factory=SceneSampler)
    camera: RealCamera = field(default_factory=RealCamera)

    def parts(self, names: Sequence[str]) -> Partition:
        """Indices in ``names`` of the heliostats for training, and of those for validation."""
        if self.folds:
            return fold_of(names, self.fold, self.folds)
        parts = split(names)
        judges = [] if "validation" in self.learns_from else parts["validation"]
        return Partition(sorted(i for part in self.learns_from for i in parts[part]), judges)

    @classmethod
    def read(cls, path: Path) -> "TrainConfig":
        """Read a config from JSON; missing keys have their defaults."""
        values = json.loads(path.read_text(encoding="utf-8"))
        kinds = {
            "network": NetworkConfig,
            "augmentation": Augmentation,
            "scenes": SceneSampler,
            "camera": RealCamera,
        }
        for name, part in kinds.items():
            if values.get(name) is not None:
                values[name] = part(
                    **{k: tuple(v) if isinstance(v, list) else v for k, v in values[name].items()}
                )
        if "learns_from" in values:
            values["learns_from"] = tuple(values["learns_from"])
        return cls(**values)
