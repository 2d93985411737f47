"""Engines that work at the tiles of a fleet forecast: threads of this process, or the workers of a Ray cluster."""

import os
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

from model.fleet import Engine
from service.base.faults import ConflictError
from service.twin.runtime import Runtime

Item = TypeVar("Item")
Made = TypeVar("Made")
Pending = TypeVar("Pending")

# How often a tile is worked at again whose worker died. One that kills every worker fails the job, and the job's own
# attempts and reason take over.
_RETRIES = 4

_joining = threading.Lock()


def engine_of(runtime: Runtime) -> Engine:
    """The engine that the settings name."""
    settings = runtime.settings
    if settings.ray_address is not None:
        return Ray(settings.ray_address)
    return Threads(settings.parallel_computations, partial(runtime.computing, "superpose"))


def in_order(
    submit: Callable[[Item], Pending], items: Iterable[Item], ahead: int, result: Callable[[Pending], Made]
) -> Iterator[Made]:
    """Results in the items' order, while up to ``ahead`` of them are under way."""
    pending: deque[Pending] = deque()
    for item in items:
        pending.append(submit(item))
        if len(pending) >= ahead:
            yield result(pending.popleft())
    while pending:
        yield result(pending.popleft())


@dataclass(frozen=True, eq=False)
class Threads:
    """The engine of one machine; PyTorch leaves Python's lock while it computes.

    Attributes
    ----------
    count : int
    turn : callable
        Gives what each piece of work is done within: a place in a queue for the processor, say.
    """

    count: int = 2
    turn: Callable[[], AbstractContextManager[object]] = nullcontext

    def map(self, work: Callable[[Item], Made], items: Iterable[Item]) -> Iterator[Made]:
        """As `model.fleet.Engine.map`."""

        def one(item: Item) -> Made:
            with self.turn():
                return work(item)

        with ThreadPoolExecutor(self.count) as pool:
            yield from in_order(lambda item: pool.submit(one, item), items, 2 * self.count, Future.result)


@dataclass(frozen=True)
class Ray:
    """The engine of many machines: each tile is a Ray task of one processor.

    A task whose worker, or whose machine, is lost is done again elsewhere.

    Attributes
    ----------
    address : str
        Where the cluster's head listens, ``HOST:6379``; ``local`` starts a cluster on this machine.
    """

    address: str

    def map(self, work: Callable[[Item], Made], items: Iterable[Item]) -> Iterator[Made]:
        """As `model.fleet.Engine.map`.

        Raises
        ------
        ConflictError
            Where Ray is not installed, or the cluster does not answer.
        """
        ray = _joined(self.address)
        task = ray.remote(num_cpus=1, max_retries=_RETRIES)(_apply)
        shared = ray.put(work)  # once to each machine, not with every tile
        ahead = 2 * max(1, int(ray.cluster_resources().get("CPU", 1)))
        yield from in_order(lambda item: task.remote(shared, item), items, ahead, ray.get)


def _apply(work: Callable[[Item], Made], item: Item) -> Made:
    return work(item)


def _joined(address: str) -> Any:
    """The module `ray`, with this process a member of the cluster."""
    # A plant's control room sends nothing to anybody.
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        import ray
    except ImportError as error:
        raise ConflictError("ray_address: Ray is not installed; pip install 'heliotwin[ray]'") from error
    with _joining:
        if not ray.is_initialized():
            try:
                ray.init(address=address, log_to_driver=False, include_dashboard=False if address == "local" else None)
            except (ConnectionError, ValueError) as error:
                raise ConflictError(
                    f"ray_address: no cluster lets us in at {address}; start Ray there and here with one token"
                ) from error
    return ray
