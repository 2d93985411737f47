"""Several processes that train one network: started by ``torchrun``, on GPUs or CPUs; alone without it.

Each process holds a whole copy of the network and renders its own share of every batch; gradients are averaged after
each backward pass, so that all copies take the same step. Process 0 writes.
"""

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

import torch
from torch import distributed, nn


@contextmanager
def team(device: str | None = None) -> Iterator[torch.device]:
    """Join the other processes where ``torchrun`` started several; gives the device, a GPU of one's own by default."""
    chosen = torch.device(device or ("cuda" if torch.cuda.is_available() else "cpu"))
    if "WORLD_SIZE" not in os.environ:
        yield chosen
        return
    if chosen.type == "cuda":
        chosen = torch.device("cuda", int(os.environ["LOCAL_RANK"]))
        torch.cuda.set_device(chosen)
    distributed.init_process_group("nccl" if chosen.type == "cuda" else "gloo")
    try:
        yield chosen
    finally:
        distributed.destroy_process_group()


def rank() -> int:
    """Which of the processes this is."""
    return distributed.get_rank() if distributed.is_initialized() else 0


def size() -> int:
    """How many processes train together."""
    return distributed.get_world_size() if distributed.is_initialized() else 1


def average_gradients(parameters: Iterable[nn.Parameter]) -> None:
    """Replace each gradient by its mean over the processes, in one exchange."""
    if size() == 1:
        return
    gradients = [p.grad for p in parameters if p.grad is not None]
    flat = torch.cat([gradient.flatten() for gradient in gradients])
    distributed.all_reduce(flat)
    means = torch.split(flat / size(), [gradient.numel() for gradient in gradients])
    for gradient, mean in zip(gradients, means, strict=True):
        gradient.copy_(mean.view_as(gradient))


def agreed(verdict: bool, device: torch.device) -> bool:
    """What process 0 thinks: clocks differ, and a process that stops alone leaves the others waiting."""
    if size() == 1:
        return verdict
    answer = torch.tensor(int(verdict), device=device)
    distributed.broadcast(answer, src=0)
    return bool(answer)
