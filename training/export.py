"""Export a run's averaged weights to ONNX, check them against torch, write the model card.

``python -m training.export --run runs/best``
"""

import argparse
import json
import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch

from model.checksums import digests
from model.images import FLUX_SIZE, normalized
from model.network.architecture import CONDITIONS, MAX_IMAGES, SurfaceNetwork
from model.network.predictor import INPUTS, WEIGHTS, SurfacePredictor
from model.surface import COLUMNS, FACETS, ROWS
from training.cases import make_cases
from training.figures import Figures, outcomes_of
from training.methods import always, by_onnx
from training.render import CleanCamera
from training.surfaces import load_part
from training.train import Run

PARITY_MM = 1e-4
"""Largest allowed difference between torch and onnxruntime [mm]."""


def example(batch: int, images: int, facets: int = FACETS) -> tuple[torch.Tensor, ...]:
    """Random inputs of the network in the order of `INPUTS`, for mirrors of so many facets.

    The first ``images`` of the eight images are present.
    """
    generator = torch.Generator().manual_seed(batch * 10 + images)
    fluxes = torch.rand(2, batch, MAX_IMAGES, FLUX_SIZE, FLUX_SIZE, generator=generator) ** 4
    flux, guess_flux = normalized(fluxes)
    conditions = torch.randn(batch, MAX_IMAGES, CONDITIONS, generator=generator)
    mask = torch.zeros(batch, MAX_IMAGES)
    mask[:, :images] = 1
    guess = 0.3 * torch.randn(batch, facets, ROWS, COLUMNS, generator=generator)
    descent = 0.05 * torch.randn(batch, MAX_IMAGES, facets, ROWS, COLUMNS, generator=generator)
    return flux, conditions, mask, guess_flux, guess, descent * mask[:, :, None, None, None]


def export(network: SurfaceNetwork, path: Path) -> None:
    """Write a `rounded` network as ONNX with a free batch size."""
    batch = torch.export.Dim("batch", min=1, max=4096)
    torch.onnx.export(
        network.eval(),
        example(2, 5, network.facets),
        str(path),
        input_names=list(INPUTS),
        output_names=["heights", "spread"],
        dynamic_shapes=tuple({0: batch} for _ in INPUTS),
        dynamo=True,
        external_data=False,
        verbose=False,
    )
    store_in_half(path)


def rounded(network: SurfaceNetwork) -> SurfaceNetwork:
    """Round the network's parameters in place to 16-bit floats."""
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.copy_(parameter.half().float())
    return network


def store_in_half(path: Path) -> None:
    """Store the large weights of an ONNX file as 16-bit floats.

    They are cast back when the file is loaded. The file has half the size, and the arithmetic is
    the same. The result is exact for a network that was `rounded` before.
    """
    model = onnx.load(path)
    casts = []
    for tensor in model.graph.initializer:
        if tensor.data_type == onnx.TensorProto.FLOAT and len(tensor.raw_data) > 4096:
            name, values = tensor.name, onnx.numpy_helper.to_array(tensor).astype(np.float16)
            tensor.CopyFrom(onnx.numpy_helper.from_array(values, f"{name}_half"))
            casts.append(
                onnx.helper.make_node("Cast", [f"{name}_half"], [name], to=onnx.TensorProto.FLOAT)
            )
    for part in (model.graph, *model.graph.node, *model.graph.value_info):
        del part.metadata_props[:]  # stack traces of the exporter, with local paths
    nodes = [*casts, *model.graph.node]
    del model.graph.node[:]
    model.graph.node.extend(nodes)
    onnx.save(model, path)


def parity(network: SurfaceNetwork, path: Path) -> float:
    """Largest difference [mm] between torch and onnxruntime.

    Batches of 1, 2 and 7 are compared, each with one to eight images.
    """
    session = SurfacePredictor(path)
    worst = 0.0
    for batch in (1, 2, 7):
        for images in range(1, MAX_IMAGES + 1):
            inputs = example(batch, images, network.facets)
            with torch.no_grad():
                expected = network(*inputs)[0].numpy()
            z, _ = session.iterate(
                {name: tensor.numpy() for name, tensor in zip(INPUTS, inputs, strict=True)}
            )
            worst = max(worst, float(np.abs(z * 1e3 - expected).max()))
    return worst


def export_checked(average: SurfaceNetwork, path: Path) -> float:
    """Export a run's averaged network, rounded; return its difference from torch [mm].

    Raises
    ------
    SystemExit
        If ONNX and torch differ by more than `PARITY_MM`.
    """
    network = rounded(average.to(memory_format=torch.contiguous_format))  # type: ignore[call-overload]
    export(network, path)
    difference = parity(network, path)
    if not math.isfinite(difference) or difference > PARITY_MM:
        raise SystemExit(
            f"ONNX differs from torch by {difference:.2e} mm, more than {PARITY_MM:.0e}"
        )
    return difference


def evaluation(run: Run, path: Path, count: int = 128) -> dict[str, Any]:
    """Results of the exported network and of reference surfaces on ``count`` test cases."""
    surfaces, names = load_part(Path(run.config.data), "test")
    clean, imperfect = (
        make_cases(surfaces, names, run.field, count, camera)
        for camera in (CleanCamera(), run.config.camera)
    )
    network, mean = by_onnx(SurfacePredictor(path)), run.mean.double().numpy()
    outcomes = {
        "ideal surface": outcomes_of(always(np.zeros_like(mean)), clean),
        "mean surface": outcomes_of(always(mean), clean),
        "network, 8 clean images": outcomes_of(network, clean),
        "network, 8 images of imperfect cameras": outcomes_of(network, imperfect),
        "network, 1 clean image": outcomes_of(network, clean, images=1),
    }
    return {
        name: asdict(Figures.of(found, outcomes["ideal surface"]))
        for name, found in outcomes.items()
    }


def model_card(run: Run, path: Path, difference: float) -> dict[str, Any]:
    """Model card: description of the weights, training data, commit and results."""
    network = run.average
    return {
        "name": path.stem,
        **digests(path),
        "task": (
            "mirror surface (4 x 8 x 8 control heights) from 1 to 8 flux images of one heliostat"
        ),
        "parameters": sum(p.numel() for p in network.parameters()),
        "trained_on": {
            "surfaces": (
                f"{len(run.surfaces)} measured surfaces of the Solar Tower Juelich (surfaces.npz),"
                " augmented"
            ),
            "learnt": run.learnt,
            "held_out": [name for name in run.names if name not in run.learnt],
            "images": (
                "convolution-traced flux with random cameras, suns of the year, field positions of"
                " Juelich"
            ),
            "steps": run.step,
            "samples": run.step * run.config.batch,
            "commit": run.commit,
        },
        "config": asdict(run.config),
        "onnx_parity_mm": difference,
        "evaluation": evaluation(run, path),
        "limits": (
            "Four-facet mirrors of the Juelich kind, flux in 4 m x 4 m windows; other mirrors are"
            " out of domain."
        ),
    }


def main() -> None:
    """Export the weights, check them and write the model card."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--run", type=Path, default=Path("runs/best"))
    parser.add_argument("--out", type=Path, default=WEIGHTS)
    arguments = parser.parse_args()
    run = Run.open(arguments.run)
    difference = export_checked(run.average, arguments.out)
    card = model_card(run, arguments.out, difference)
    arguments.out.with_suffix(".json").write_text(
        json.dumps(card, indent=1) + "\n", encoding="utf-8"
    )
    print(json.dumps(card["evaluation"], indent=1))
    print(
        f"{arguments.out}: {arguments.out.stat().st_size / 1e6:.1f} MB, parity {difference:.1e} mm"
    )


if __name__ == "__main__":
    main()
