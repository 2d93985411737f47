"""Engines that compute the tiles of a field forecast: threads or a Ray cluster."""

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
from service.base.errors import ConflictError
from service.twin.runtime import Runtime

Item = TypeVar("Item")
Made = TypeVar("Made")
Pending = TypeVar("Pending")

# Retries of a tile whose worker died. If a tile kills all workers, the job fails and may be
# retried.
_RETRIES = 4

_joining = threading.Lock()


def engine_of(runtime: Runtime) -> Engine:
    """The engine that the settings select."""
    settings = runtime.settings
    if settings.ray_address is not None:
        return Ray(settings.ray_address)
    return Threads(settings.parallel_computations, partial(runtime.computing, "superpose"))


def in_order(
    submit: Callable[[Item], Pending],
    items: Iterable[Item],
    ahead: int,
    result: Callable[[Pending], Made],
) -> Iterator[Made]:
    """Yield results in the items' order, with up to ``ahead`` items in progress."""
    pending: deque[Pending] = deque()
    for item in items:
        pending.append(submit(item))
        if len(pending) >= ahead:
            yield result(pending.popleft())
    while pending:
        yield result(pending.popleft())


@dataclass(frozen=True, eq=False)
class Threads:
    """Engine of one machine; PyTorch releases Python's lock while it computes.

    Attributes
    ----------
    count : int
        Number of threads.
    turn : callable
        Creates the context in which each item is computed, such as a compute slot.
    """

    count: int = 2
    turn: Callable[[], AbstractContextManager[object]] = nullcontext

    def map(self, work: Callable[[Item], Made], items: Iterable[Item]) -> Iterator[Made]:
        """See `model.fleet.Engine.map`."""

        def one(item: Item) -> Made:
            with self.turn():
                return work(item)

        with ThreadPoolExecutor(self.count) as pool:
            yield from in_order(
                lambda item: pool.submit(one, item), items, 2 * self.count, Future.result
            )


@dataclass(frozen=True)
class Ray:
    """Engine of many machines: each tile is a Ray task of one processor.

    If a worker or machine is lost, its task runs again elsewhere.

    Attributes
    ----------
    address : str
        Address of the cluster's head, ``HOST:6379``; ``local`` starts a cluster on this machine.
    """

    address: str

    def map(self, work: Callable[[Item], Made], items: Iterable[Item]) -> Iterator[Made]:
        """See `model.fleet.Engine.map`.

        Raises
        ------
        ConflictError
            If Ray is not installed, or the cluster does not answer.
        """
        ray = _joined(self.address)
        task = ray.remote(num_cpus=1, max_retries=_RETRIES)(_apply)
        shared = ray.put(work)  # once per machine, not with every tile
        ahead = 2 * max(1, int(ray.cluster_resources().get("CPU", 1)))
        yield from in_order(lambda item: task.remote(shared, item), items, ahead, ray.get)


def _apply(work: Callable[[Item], Made], item: Item) -> Made:
    return work(item)


def _joined(address: str) -> Any:
    """The module `ray`, after this process has joined the cluster."""
    # A plant must not send usage statistics.
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        import ray
    except ImportError as error:
        raise ConflictError(
            "ray_address: Ray is not installed; pip install 'heliotwin[ray]'"
        ) from error
    with _joining:
        if not ray.is_initialized():
            try:
                ray.init(
                    address=address,
                    log_to_driver=False,
                    include_dashboard=False if address == "local" else None,
                )
            except (ConnectionError, ValueError) as error:
                raise ConflictError(
                    f"ray_address: no cluster lets us in at {address}; start Ray there and here"
                    " with one token"
                ) from error
    return ray
