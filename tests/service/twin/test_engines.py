"""Tiles of a fleet forecast on a Ray cluster of two worker processes: the same light, whatever
happens to a worker.
"""

import os
import signal
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from model.aiming.kernels import ImageTracer, MirrorImages
from model.fleet import FleetFlux, Superposition, Tile, aligned_field, superpose, tiles
from model.frames import sun_direction
from model.plant import Heliostat
from model.plant_model import JUELICH_MODEL
from model.setup import Setup
from model.surface import control_points
from service.base.errors import ConflictError
from service.jobs.kinds import KINDS
from service.jobs.worker import Worker
from service.twin.engines import Ray, Threads, engine_of
from tests.conftest import target
from tests.service.twin.fields import FLEET, runtime_of

SUN = sun_direction(160.0, 30.0)


def some_tiles() -> list[Tile]:
    positions = [np.array([-20.0 + 5 * (i % 8), 60.0 + 5 * (i // 8), 1.8]) for i in range(32)]
    heliostats = [
        Heliostat.juelich(f"H{i}", position, 80.0) for i, position in enumerate(positions)
    ]
    plane = target(10.0)
    shots = [Setup(one, control_points(one), SUN, plane) for one in heliostats]
    return list(
        tiles(
            shots,
            aligned_field([(one, plane.center) for one in heliostats], SUN, JUELICH_MODEL),
            size=8,
        )
    )


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    ray = pytest.importorskip("ray", reason="Ray is not installed: pip install 'heliotwin[ray]'")
    ray.init(address="local", num_cpus=2, include_dashboard=False, log_to_driver=False)
    yield ray
    ray.shutdown()


pytestmark = pytest.mark.filterwarnings("ignore::FutureWarning:ray", "ignore::ResourceWarning")


@pytest.mark.parametrize("count", [1, 3])
def test_threads_give_the_same_light_whatever_their_number(count: int):
    task, parts = Superposition(target(10.0), JUELICH_MODEL, (32, 32)), some_tiles()
    expected, made = superpose(task, parts), superpose(task, parts, Threads(count))
    assert (made.heliostats, made.power) == (expected.heliostats, expected.power)
    np.testing.assert_array_equal(made.irradiance, expected.irradiance)


@pytest.mark.full
def test_cluster_traces_the_same_images_of_mirrors(cluster: Any):
    task = ImageTracer(Superposition(target(10.0), JUELICH_MODEL, (32, 32)), 1)
    images, expected = (
        MirrorImages.join(
            (one for tile in engine.map(task, some_tiles()) for one in tile.images), 32
        )
        for engine in (Ray("local"), Threads(1))
    )
    assert images is not None
    assert expected is not None
    assert images.names == expected.names
    assert len(images) == 32
    for name in ("expected", "sharp", "sides", "spread", "aims", "axes"):
        assert torch.equal(getattr(images, name), getattr(expected, name))


@pytest.mark.full
def test_cluster_gives_the_same_light_also_where_a_worker_is_killed(cluster: Any, tmp_path: Path):
    task, parts = Superposition(target(10.0), JUELICH_MODEL, (32, 32)), some_tiles()
    expected = superpose(task, parts, Threads(1))
    begun = tmp_path / "begun"

    class Killing:
        """The task; the first worker to meet the second tile is killed over it."""

        receiver, resolution = task.receiver, task.resolution

        def __call__(self, tile: Tile) -> tuple[int, FleetFlux]:
            if tile.setups[0].heliostat.name == "H8":
                is_first = not begun.exists()
                with begun.open("a") as file:
                    file.write(f"{os.getpid()}\n")
                if is_first:
                    os.kill(os.getpid(), signal.SIGKILL)
            return os.getpid(), task(tile)

    made = list(Ray("local").map(Killing(), parts))
    killed, successor = (int(line) for line in begun.read_text().splitlines())
    # How many workers share the other tiles is the cluster's affair: one may be fast enough for
    # all.
    assert [process for process, _ in made][1] == successor != killed
    assert len(made) == len(parts) > 2
    total = sum((flux for _, flux in made), FleetFlux(np.zeros(task.resolution)))
    assert (total.heliostats, total.skipped) == (32, {})
    np.testing.assert_allclose(
        total.irradiance.clip(min=0), expected.irradiance, atol=1e-6 * expected.irradiance.max()
    )
    assert total.power == pytest.approx(expected.power, rel=1e-6)


@pytest.mark.full
@pytest.mark.parametrize("store_url", ["sqlite"], indirect=True)
def test_service_forecasts_on_the_cluster(cluster: Any, field: Any):
    runtime = runtime_of(field)
    fluxes = []
    for address in (None, "local"):
        object.__setattr__(
            runtime, "settings", runtime.settings.model_copy(update={"ray_address": address})
        )
        assert isinstance(engine_of(runtime), Threads if address is None else Ray)
        job = field.post("/v1/jobs/forecasts", json=FLEET).headers["Location"]
        assert Worker(runtime, KINDS, "tester", threading.Event()).work()
        assert field.get(job).json()["state"] == "done", field.get(job).json()["reason"]
        fluxes.append(np.array(field.get(f"{job}/flux").json()["flux"]))
    np.testing.assert_allclose(fluxes[1], fluxes[0], atol=1e-6 * fluxes[0].max())


def test_without_ray_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ConflictError, match=r"pip install 'heliotwin\[ray\]'"):
        next(Ray("local").map(len, ["a"]))
