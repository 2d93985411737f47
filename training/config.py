"""What decides a training run."""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from model.network.architecture import NetworkConfig
from model.network.catalogue import NETWORKS, sizes_of
from training.render import Camera, Situations
from training.surfaces import Augmentation


@dataclass(frozen=True)
class TrainConfig:
    """Everything that decides a run; stored beside its result.

    ``architecture`` is a name of `model.network.catalogue`, and ``network`` has its sizes. ``looks`` is how often the
    network sees its own guess.
    ``fold`` counts which ``held_out`` heliostats are kept back; ``batch`` is shared among processes.
    """

    data: str = "../shared/stj"
    seed: int = 7
    held_out: int = 8
    fold: int = 0
    steps: int = 20000
    batch: int = 32
    learning_rate: float = 3e-4
    warmup: int = 300
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

    @classmethod
    def read(cls, path: Path) -> "TrainConfig":
        """A config from JSON; keys that are left out keep their defaults.

        Another network may be named by its sizes alone, as in ``{"paper": {}}``.
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
        return cls(**values)
