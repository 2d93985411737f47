"""The networks of heliostat types, next to the shipped one of Juelich's.

A network is three files of a folder: ``NAME.onnx``, its model card ``NAME.json`` and the prior that
it was trained with, ``NAME-prior.npz``. `training.type_network` writes them.
"""

import json
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from model.checksums import read_verified
from model.errors import InvalidInputError, WeightsError
from model.mirror_kind import MirrorKind
from model.network.predictor import SurfacePredictor, default_predictor, juelich_kind
from model.plant import Heliostat
from model.prior import SurfacePrior


@dataclass(frozen=True)
class Networks:
    """The networks of a folder, and the shipped one.

    Attributes
    ----------
    folder : Path or None
        It need not exist; None for the shipped network alone.
    """

    folder: Path | None = None

    def of(self, heliostat: Heliostat) -> SurfacePredictor | None:
        """The network that was trained for a heliostat's kind of mirror, or None.

        Those of the folder come before the shipped one.

        Raises
        ------
        WeightsError
            If a file of the folder is missing, damaged or not as its card says.
        """
        for predictor in self.trained():
            if predictor.kind.includes(heliostat):
                return predictor
        return default_predictor() if juelich_kind().includes(heliostat) else None

    def trained(self) -> list[SurfacePredictor]:
        """The networks of the folder by name, each loaded once until its files change."""
        if self.folder is None or not self.folder.is_dir():
            return []
        return [
            _load(path, path.stat().st_mtime_ns, _card_path(path).stat().st_mtime_ns)
            for path in sorted(self.folder.glob("*.onnx"))
            if _has_card(path)
        ]


SHIPPED = Networks()
"""The shipped network alone."""


def prior_path(network: Path) -> Path:
    """The file of the prior of a network's file."""
    return network.with_name(f"{network.stem}-prior.npz")


def _card_path(network: Path) -> Path:
    return network.with_suffix(".json")


def _has_card(network: Path) -> bool:
    if not _card_path(network).is_file():
        raise WeightsError(
            f"{network.name} has no model card {_card_path(network).name}; {_REMEDY}"
        )
    return True


_REMEDY = "train the network again, or remove its files"


@lru_cache(maxsize=64)
def _load(network: Path, changed_ns: int, card_changed_ns: int) -> SurfacePredictor:
    """Load a network; the times are those of the last changes of its file and its card."""
    card: dict[str, Any] = json.loads(_card_path(network).read_text(encoding="utf-8"))
    try:
        kind = MirrorKind.from_json(card["mirrors"])
        prior = SurfacePrior.load(prior_path(network))
        if prior.name != card["prior"]["weights"]:
            raise WeightsError(
                f"{prior_path(network).name} is not the prior of {network.name}; {_REMEDY}"
            )
    except (KeyError, TypeError, OSError, InvalidInputError) as error:
        raise WeightsError(f"{network.name}: {error}; {_REMEDY}") from error
    return SurfacePredictor(
        network, read=lambda path: read_verified(path, _REMEDY), kind=kind, prior=prior
    )
