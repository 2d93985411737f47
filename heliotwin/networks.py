"""Train the network of a heliostat type: ``python -m heliotwin.networks PLANT.yaml --type NAME``.

Its files are written into the folder ``networks`` next to ``plant.yaml``. `heliotwin predict` uses
them for that type. The service has its networks in the folder of the setting ``networks_dir``.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from model.errors import InvalidInputError, ModelError
from model.plant import Heliostat
from model.surface import COLUMNS, ROWS
from service.sources.folder import measured_heights, read_surface
from service.sources.plant_file import read_plant
from training.config import TrainConfig
from training.type_network import TypeRun, TypeScenes, write_network

CONFIG = Path(__file__).parents[1] / "training" / "configs" / "best.json"


def train_network(
    plant_file: str | Path,
    heliostat_type: str,
    *,
    out: str | Path | None = None,
    config: TrainConfig | None = None,
    minutes: float = float("inf"),
) -> dict[str, Any]:
    """Train the network of one heliostat type.

    Mirrors are drawn from a prior: that of measured mirrors of the type, if the plant's folder has
    ``H/Deflectometry`` of any, otherwise that of the type's declared ``slope_error_mrad``. The work
    can be interrupted; the next call with the same ``out`` continues it.

    Parameters
    ----------
    plant_file : str or Path
        ``plant.yaml``.
    heliostat_type : str
        A key of its ``heliostat_types``.
    out : str or Path, optional
        Folder of the network; by default ``networks`` next to the plant's file.
    config : TrainConfig, optional
        By default that of the shipped network.
    minutes : float
        The training ends after so many minutes at the latest.

    Returns
    -------
    dict
        The model card.

    Raises
    ------
    InvalidInputError
        If the file is wrong, has no such type, or the type has no heliostat or no target.
    """
    path = Path(plant_file)
    scenes = read_scenes(path, heliostat_type)
    folder = path.parent / "networks" if out is None else Path(out)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    config = config or TrainConfig.read(CONFIG)
    run = TypeRun(scenes, config, folder / "runs" / heliostat_type, device)
    run.train(minutes)
    return write_network(run, folder)


def read_scenes(plant_file: Path, heliostat_type: str) -> TypeScenes:
    """Read what a type's network is trained on: heliostats, targets, sun and measured mirrors."""
    plant = read_plant(plant_file)
    if heliostat_type not in plant.types:
        raise InvalidInputError(
            f"type: {heliostat_type!r} is none of {', '.join(plant.types)} in {plant_file.name}"
        )
    heliostats = [
        heliostat
        for name, heliostat in plant.plant.heliostats.items()
        if plant.type_of[name] == heliostat_type
    ]
    if not heliostats:
        raise InvalidInputError(
            f"{plant_file.name}: no heliostat of the layout is of type {heliostat_type}; add one"
        )
    if not plant.plant.targets:
        raise InvalidInputError(
            f"{plant_file.name}: targets: has none; add what the heliostats are photographed on"
        )
    return TypeScenes(
        heliostat_type,
        heliostats,
        list(plant.plant.targets.values()),
        plant.plant.site,
        plant.optics,
        _measured(plant_file.parent, heliostats),
    )


def _measured(root: Path, heliostats: list[Heliostat]) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Measured mirrors (N, F, 8, 8) [m] of the folder."""
    found = []
    for heliostat in heliostats:
        surface = read_surface(root, heliostat)
        if surface is not None:
            found.append(measured_heights(heliostat, surface))
    shape = (0, len(heliostats[0].facets), ROWS, COLUMNS)
    return np.array(found) if found else np.zeros(shape)


def main(arguments: list[str] | None = None) -> None:
    """Train, or continue, the network of one type."""
    parser = argparse.ArgumentParser(
        prog="python -m heliotwin.networks",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("plant", type=Path, metavar="PLANT.yaml")
    parser.add_argument("--type", required=True, help="key of heliostat_types")
    parser.add_argument("--out", type=Path, help="folder of the network")
    parser.add_argument("--steps", type=int, help="of the training; by default as the shipped one")
    parser.add_argument("--minutes", type=float, default=float("inf"))
    options = parser.parse_args(arguments)
    config = TrainConfig.read(CONFIG)
    if options.steps is not None:
        config = replace(config, steps=options.steps)
    try:
        card = train_network(
            options.plant, options.type, out=options.out, config=config, minutes=options.minutes
        )
    except ModelError as error:
        parser.error(str(error))
    print(json.dumps({key: card[key] for key in ("name", "weights", "mirrors", "evaluation")}))


if __name__ == "__main__":
    main()
