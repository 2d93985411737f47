"""Two processes that train one network."""

import os
import socket
from pathlib import Path

import pytest
import torch
from torch import multiprocessing, nn

from model.network.architecture import NetworkConfig
from training import parallel
from training.config import TrainConfig
from training.train import Run

SMALL = NetworkConfig(channels=(4, 8, 8), features=16, hidden=32)


def member(rank: int, data: str, folder: Path, port: int) -> None:
    """One process: a gradient to average, then three steps of a run; leaves what it saw in ``folder``."""
    torch.set_num_threads(1)
    os.environ.update(
        RANK=str(rank), LOCAL_RANK=str(rank), WORLD_SIZE="2", MASTER_ADDR="127.0.0.1", MASTER_PORT=str(port)
    )
    with parallel.team("cpu") as device:
        parameter = nn.Parameter(torch.zeros(2, 3))
        parameter.grad = torch.full((2, 3), float(rank))
        parallel.average_gradients([parameter])
        verdict = parallel.agreed(rank == 1, device)
        config = TrainConfig(data=data, steps=3, batch=4, warmup=1, network=SMALL, bfloat16=False)
        run = Run(config, folder / "run", device)
        error = run.train_step()
        run.train(minutes=1, every=3)
        weights = torch.cat([p.detach().flatten() for p in run.network.parameters()])
    torch.save({"mean": parameter.grad, "verdict": verdict, "error": error, "weights": weights}, folder / str(rank))


def test_processes_share_the_batches_and_take_the_same_steps(stj, tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    multiprocessing.spawn(member, (str(stj), tmp_path, port), nprocs=2)
    first, second = (torch.load(tmp_path / str(rank), weights_only=True) for rank in range(2))
    torch.testing.assert_close(first["mean"], torch.full((2, 3), 0.5))
    assert not first["verdict"]
    assert not second["verdict"]
    assert first["error"] != pytest.approx(second["error"], rel=1e-3)
    torch.testing.assert_close(first["weights"], second["weights"], rtol=0, atol=0)
    state = torch.load(tmp_path / "run" / "checkpoint.pt", weights_only=True)
    assert state["step"] == 3
    assert len((tmp_path / "run" / "curve.jsonl").read_text().splitlines()) == 1
