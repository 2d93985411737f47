"""What decides a training run."""

import json
from dataclasses import dataclass, field
from pathlib import Path

from model.network.architecture import NetworkConfig
from model.network.paper import PaperConfig
from training.render import Camera, Situations
from training.surfaces import Augmentation


@dataclass(frozen=True)
class TrainConfig:
    """Everything that decides a run; stored beside its result.

    ``paper`` takes the place of ``network`` where it is given; ``looks`` is how often the network sees its own guess.
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
    network: NetworkConfig = field(default_factory=NetworkConfig)
    paper: PaperConfig | None = None
    augmentation: Augmentation = field(default_factory=Augmentation)
    situations: Situations = field(default_factory=Situations)
    camera: Camera = field(default_factory=Camera)

    @classmethod
    def read(cls, path: Path) -> "TrainConfig":
        """A config from JSON; keys that are left out keep their defaults."""
        values = json.loads(path.read_text(encoding="utf-8"))
        parts = {
            "network": NetworkConfig,
            "paper": PaperConfig,
            "augmentation": Augmentation,
            "situations": Situations,
            "camera": Camera,
        }
        for name, part in parts.items():
            if values.get(name) is not None:
                values[name] = part(**{k: tuple(v) if isinstance(v, list) else v for k, v in values[name].items()})
        return cls(**values)
