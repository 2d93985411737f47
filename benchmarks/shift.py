"""Does the twin get better by what it offers? ``python -m benchmarks.shift --seeds 2``.

The demonstration's generator makes fields over eight weeks with every kind of fault that it knows,
strong or weak, and fields without a fault. A robot takes the first action that REST offers for each
alarm, studies and their adoption included, until nothing is offered. Photographs of two further
weeks, which the store never gets, judge each action: a copy of the store forecasts them before and
after. The oracle is the same field with nothing but its changed mirrors, which were always so.
"""

import argparse
import shutil
import tempfile
import threading
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from statistics import fmean as mean
from typing import Any, NamedTuple
from unittest import mock

import numpy as np
from fastapi.testclient import TestClient

from benchmarks.record import log_row, proportion, recording
from model.ephemeris import sun_positions
from model.imaging.light import Srgb
from model.plant import Plant
from model.prior import prior_of
from service.base.settings import Settings
from service.cli import demo_field
from service.cli.demo_field import Fault, PlannedPhotograph
from service.jobs.kinds import KINDS
from service.jobs.worker import Worker
from service.sources.folder import read_folder
from service.twin.alarms.field_updates import FieldStateWriter
from service.twin.photographs.repeats import receive
from service.twin.runtime.runtime import Runtime
from service.twin.transfer.importing import import_folder
from service.web.app import create_app

DAYS, ARCHIVED, UNSEEN = 70, 42, 14  # [d] before the end: begin, import, and what is never given
WORSE = 0.002
"""Loss of accuracy [1] on unseen photographs that makes an action a bad one."""

# Sizes as `Fault` has them: strong and weak.
SIZES = {
    "facet canted": (6.0, 2.5),
    "soiled": (0.45, 0.2),
    "drives stepped": (9.0, 3.0),
    "drifting": (0.4, 0.1),  # [mrad/d]
    "clock": (1.0, 0.5),
    "neighbour": (1.0, 1.0),
    "no surface": (0.0, 0.0),
    "hazy": (0.35, 0.35),
    "target moved": (0.4, 0.15),  # [m]
    "camera changed": (0.6, 0.85),  # power of the new camera's curve
}
OF_FIELD = ("hazy", "target moved", "camera changed")
LASTING = ("facet canted", "drives stepped", "drifting", "target moved", "camera changed")


@dataclass(frozen=True)
class Case:
    """A field: its plant, planned photographs and faults."""

    plant: Plant
    photographs: list[PlannedPhotograph]
    faults: tuple[Fault, ...]


def make_case(
    root: Path, seed: int, strength: int | None, heliostats: int, each: int, *, oracle: bool = False
) -> Case:
    """Plan a field with strong (0), weak (1) or no faults (None).

    For the oracle, mirrors that change have always been so, and nothing else is wrong.
    """
    now = datetime.now(UTC).replace(hour=0, minute=0, second=0, microsecond=0)
    rng = np.random.default_rng(seed)
    whole = demo_field.write_layout(root)
    names = rng.choice(sorted(whole.heliostats), heliostats, replace=False).tolist()
    plant = replace(whole, heliostats={name: whole.heliostats[name] for name in sorted(names)})
    faults = () if strength is None else tuple(_faults(rng, names, strength))
    acting = (
        [replace(fault, days=(DAYS, 0)) for fault in faults if fault.kind == "facet canted"]
        if oracle
        else list(faults)
    )
    photographs = []
    for name, mirror in plant.heliostats.items():
        own = np.random.default_rng(zlib.crc32(f"{seed} {name}".encode()))
        z = demo_field._true_mirror(prior_of(mirror), own)
        zeros = own.normal(0, demo_field._MOUNT_RAD, 2)
        count = round(each * DAYS / (DAYS - UNSEEN))
        ago = np.ceil(DAYS * (np.arange(count, 0, -1) - own.uniform(0, 1, count)) / count)
        hours = own.permutation(np.linspace(9, 15.5, count)) + own.uniform(-0.2, 0.2, count)
        for days, hour in zip(ago.tolist(), hours.tolist(), strict=True):
            taken_at = now + timedelta(days=-days, seconds=round(hour * 3600))
            acts = {one.kind: one for one in acting if one.acts(name, days)}
            sizes = {kind: fault.size for kind, fault in acts.items()}
            turned = zeros
            if "drifting" in acts:
                turned = zeros + 1e-3 * sizes["drifting"] * (acts["drifting"].days[0] - days) / 2
            shown, heights = mirror, z
            if "neighbour" in acts:
                other = plant.heliostats[names[(names.index(name) + 1) % len(names)]]
                shown = replace(other, name=name)
                heights = demo_field._true_mirror(prior_of(other), np.random.default_rng(1))
            photographs.append(
                PlannedPhotograph(shown, heights, turned, taken_at, sizes, 0, np.zeros(2))
            )
    photographs.sort(key=lambda one: one.taken_at)
    suns = sun_positions([one.taken_at for one in photographs], plant.origin)
    numbered = [
        replace(one, number=1001 + place, sun=sun)
        for place, (one, sun) in enumerate(zip(photographs, suns, strict=True))
    ]
    return Case(plant, numbered, faults)


def _faults(rng: np.random.Generator, names: Sequence[str], strength: int) -> Iterator[Fault]:
    """One fault of each kind, each on other heliostats."""
    free = iter(rng.permutation(names).tolist())
    for kind, sizes in SIZES.items():
        begin = float(UNSEEN + rng.integers(12, 24))
        end = 0.0 if kind in LASTING else max(begin - 8, UNSEEN)
        if kind == "hazy":
            yield Fault(kind, (), (begin, begin - 7), sizes[strength])
        elif kind in OF_FIELD:
            if rng.random() < 0.5:  # both would hide each other
                yield Fault(kind, (), (begin, end), sizes[strength])
        elif kind == "clock":
            yield Fault(kind, (next(free), next(free)), (UNSEEN + 4, UNSEEN), sizes[strength])
        elif kind == "no surface":
            yield Fault(kind, (next(free),), (DAYS, 0), 0.0)
        else:
            yield Fault(kind, (next(free),), (begin, end), sizes[strength])


def write(root: Path, case: Case, photographs: Sequence[PlannedPhotograph]) -> None:
    """Write photographs into the folder; those of another camera or a moved target apart."""
    for moved in (False, True):
        for camera in (False, True):
            some = [
                one
                for one in photographs
                if ("target moved" in one.faults, "camera changed" in one.faults) == (moved, camera)
            ]
            if not some:
                continue
            plant = case.plant
            if moved:
                shift = some[0].faults["target moved"]
                plant = replace(
                    plant,
                    targets={
                        name: replace(one, center=one.to_enu(np.array([shift, 0.0])))
                        for name, one in plant.targets.items()
                    },
                )
            power = some[0].faults["camera changed"] if camera else 1.0
            with mock.patch.object(demo_field, "Srgb", lambda power=power: _Bent(power)):
                demo_field.write_photographs(root, plant, some)


@dataclass(frozen=True)
class _Bent:
    """A camera whose counts are a power of those of sRGB."""

    power: float

    def counts(self, light: np.ndarray) -> np.ndarray:
        return Srgb().counts(light) ** self.power


# --- the store
# --------------------------------------------------------------------------------------------------


@contextmanager
def service_on(store: Path) -> Iterator[tuple[TestClient, Runtime]]:
    """A client of the service on a store; jobs run only where `work` runs them."""
    settings = Settings(data_dir=store, database_url=None, host="127.0.0.1", job_workers=0)
    app = create_app(settings)
    with TestClient(app, base_url="http://127.0.0.1") as client:
        yield client, app.state.runtime


def work(runtime: Runtime) -> None:
    """Do all jobs, and write the state of the field."""
    worker = Worker(runtime, KINDS, "robot", threading.Event())
    while worker.work():
        pass
    writer = FieldStateWriter(runtime)
    while writer.update():
        pass


def fill(root: Path, store: Path, case: Case) -> None:
    """Import a part, make surfaces and mounts, and receive the rest one by one."""
    end = max(one.taken_at for one in case.photographs)
    begin, unseen = (end - timedelta(days=days) for days in (ARCHIVED, UNSEEN))
    older = [one for one in case.photographs if one.taken_at < begin]
    newer = [one for one in case.photographs if begin <= one.taken_at < unseen]
    lacking = {name for one in case.faults if one.kind == "no surface" for name in one.heliostats}
    write(root, case, older)
    with service_on(store) as (client, runtime):
        import_folder(runtime, read_folder(root, sorted(case.plant.heliostats)), actor="robot")
        names = sorted(set(case.plant.heliostats) - lacking)
        sent(client, "POST", "/v1/jobs/predictions", {"heliostats": names, "images": 8})
        sent(client, "POST", "/v1/jobs/calibrations", {})
        work(runtime)
        write(root, case, newer)
        give(runtime, root, newer)
        work(runtime)


def give(runtime: Runtime, root: Path, photographs: Sequence[PlannedPhotograph]) -> list[Any]:
    """Send photographs, as a calibration system does; what is stored of each."""
    folder = read_folder(root, sorted({one.mirror.name for one in photographs}))
    wanted, rows = {str(one.number) for one in photographs}, []
    for name in sorted({one.mirror.name for one in photographs}):
        for one in folder.measurements(name):
            if one.identifier in wanted:
                (image,) = one.images.items()
                photograph, data = one.photograph(image[0]), image[1].read_bytes()
                rows.append((name, receive(runtime, name, photograph, data, actor="robot").row))
    return rows


def sent(client: TestClient, method: str, path: str, body: Any) -> Any:
    """Send a request, which must succeed."""
    answer = client.request(method, path, json=body)
    assert answer.status_code < 300, (method, path, body, answer.text)
    return answer.json()


def judge(store: Path, unseen: Path, photographs: Sequence[PlannedPhotograph]) -> dict[str, float]:
    """Accuracy [1] of forecasts of unseen photographs, by heliostat, in a copy of the store."""
    found: dict[str, list[float]] = {}
    with tempfile.TemporaryDirectory() as copied:
        shutil.copytree(store, copied, dirs_exist_ok=True)
        with service_on(Path(copied)) as (_, runtime):
            for name, row in give(runtime, unseen, photographs):
                if row.forecast_accuracy is not None:
                    found.setdefault(name, []).append(row.forecast_accuracy)
    return {name: mean(values) for name, values in found.items()}


# --- the robot
# --------------------------------------------------------------------------------------------------


def offers(client: TestClient) -> list[tuple[str | None, dict[str, Any]]]:
    """The first offer for each alarm: of its plant or of its heliostat, with the heliostat."""
    found: dict[str | None, dict[str, Any]] = {}
    for alarm in client.get("/v1/alarms", params={"limit": 500}).json()["items"]:
        name = alarm["heliostat"]
        if name in found:
            continue
        path = "/v1/alarms/causes" if name is None else f"/v1/heliostats/{name}/causes"
        causes = client.get(path).json()["items"]
        offered = next((one["offer"] for one in causes if one.get("offer")), None)
        if offered is not None:
            found[name] = offered
    return list(found.items())


class Action(NamedTuple):
    """What was done, its gain [1] for its heliostat or the field, and the worst of both."""

    label: str
    gain: float
    worst: float


def run_shift(
    store: Path, unseen: Path, photographs: Sequence[PlannedPhotograph], most: int
) -> tuple[list[Action], dict[str, float]]:
    """Take offers until none is left; the change of accuracy [1] by each, and all at the end."""
    done, changes = set[str](), list[Action]()
    before = judge(store, unseen, photographs)
    for _ in range(most):
        with service_on(store) as (client, runtime):
            left = [
                (name, offer) for name, offer in offers(client) if str((name, offer)) not in done
            ]
            if not left:
                break
            name, offer = left[0]
            done.add(str((name, offer)))
            answer = client.request(offer["method"], offer["path"], json=offer["body"])
            print(name, offer["label"], answer.status_code, flush=True)
            work(runtime)
        some = [one for one in photographs if name is None or one.mirror.name == name]
        after = before | judge(store, unseen, some)
        gains = {one: after[one] - before.get(one, 0.0) for one in after}
        field = mean(after.values()) - mean(before.values())
        label = f"{name or 'plant'}: {offer['label']}"
        changes.append(Action(label, gains.get(name, field), min(field, *gains.values())))
        before = after
    return changes, before


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--heliostats", type=int, default=60)
    parser.add_argument("--each", type=int, default=24, help="photographs of a heliostat")
    parser.add_argument("--most", type=int, default=60, help="actions of a field")
    parser.add_argument("--strengths", nargs="+", default=["strong", "weak", "none"])
    options = parser.parse_args()
    table = "A robot takes what alarms offer"
    with recording("shift"):
        for word in options.strengths:
            strength = {"strong": 0, "weak": 1, "none": None}[word]
            changes, gained = list[Action](), list[float]()
            gaps, untouched = list[float](), 0
            for seed in range(options.seeds):
                with tempfile.TemporaryDirectory() as folder:
                    root = Path(folder)
                    size = (seed, strength, options.heliostats, options.each)
                    case = make_case(root / "plant", *size)
                    end = max(one.taken_at for one in case.photographs)
                    later = [
                        one
                        for one in case.photographs
                        if one.taken_at >= end - timedelta(days=UNSEEN)
                    ]
                    fill(root / "plant", root / "store", case)
                    shutil.copytree(root / "plant", root / "unseen")
                    write(root / "unseen", case, later)
                    begun = judge(root / "store", root / "unseen", later)
                    made, ended = run_shift(root / "store", root / "unseen", later, options.most)
                    changes += made
                    untouched += not made
                    gained.append(mean(ended.values()) - mean(begun.values()))
                    ideal = make_case(root / "ideal", *size, oracle=True)
                    fill(root / "ideal", root / "oracle", ideal)
                    best = judge(root / "oracle", root / "unseen", later)
                    gaps.append(mean(best.values()) - mean(ended.values()))
            bad = [one for one in changes if one.worst < -WORSE]
            for one in changes:
                print(f"{100 * one.gain:+.2f} points  {one.label}")
            cells = {
                "actions": len(changes),
                "of them made unseen photographs worse": len(bad),
                "fields without an action": proportion(untouched, options.seeds),
                "gain [points]": 100 * mean(gained),
                "below the oracle [points]": 100 * mean(gaps),
            }
            log_row(table, word, cells, n=options.seeds)


if __name__ == "__main__":
    main()
