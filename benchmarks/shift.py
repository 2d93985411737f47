"""Does the twin get better by what it offers? ``python -m benchmarks.shift --seeds 2``.

The demonstration's generator makes fields over eight weeks with every kind of fault that it knows,
strong or weak, and fields without a fault. A robot takes the first action that REST offers for each
alarm, studies and their adoption included, until nothing is offered. Photographs of two further
weeks, which the store never gets, judge each action: a copy of the store forecasts them before and
after. The oracle is the same field with nothing but its changed mirrors, which were always so, and
its changed camera, whose exact curve decodes its photographs. Surfaces that a fault makes new are
refined, as the robot refines them.

``results/shift.json`` is written after each field, so an interrupted run keeps what it has.
"""

import argparse
import re
import shutil
import tempfile
import threading
import time
import zlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from datetime import UTC, datetime, timedelta
from multiprocessing import get_context
from pathlib import Path
from statistics import fmean as mean
from typing import Any, NamedTuple
from unittest import mock

import numpy as np
from fastapi.testclient import TestClient
from numpy.typing import NDArray

from benchmarks.record import log_row, proportion, recording
from heliotwin.demo import field as demo_field
from heliotwin.demo.field import Fault, PlannedPhotograph
from model.ephemeris import sun_positions
from model.imaging.light import Srgb
from model.plant import Plant
from model.prior import prior_of
from service.base.settings import Settings
from service.jobs.kinds import KINDS
from service.jobs.worker import Worker
from service.sources.folder import read_folder
from service.twin.alarms.field_updates import FieldStateWriter
from service.twin.importing import import_folder
from service.twin.photographs.repeats import receive
from service.twin.runtime import Runtime
from service.web.app import create_app

DAYS, ARCHIVED, UNSEEN = 70, 42, 14  # [d] before the end: begin, import, and what is never given
WORSE = 0.002
"""Loss of accuracy [1] on unseen photographs that makes an action a bad one."""

MOST_BELOW = 12
"""Heliostats that are printed with what they are below the oracle."""

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
REMADE = ("facet canted", "no surface")
"""Faults after which the twin makes another surface."""

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

    For the oracle, mirrors that change have always been so. Nothing else is wrong but the camera,
    whose curve the oracle knows (`write`).
    """
    now = datetime.now(UTC).replace(hour=0, minute=0, second=0, microsecond=0)
    rng = np.random.default_rng(seed)
    whole = demo_field.write_layout(root)
    names = rng.choice(sorted(whole.heliostats), heliostats, replace=False).tolist()
    plant = replace(whole, heliostats={name: whole.heliostats[name] for name in sorted(names)})
    faults = () if strength is None else tuple(_faults(rng, names, strength))
    acting = (
        [
            fault if fault.kind == "camera changed" else replace(fault, days=(DAYS, 0))
            for fault in faults
            if fault.kind in ("camera changed", "facet canted")
        ]
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


def write(
    root: Path, case: Case, photographs: Sequence[PlannedPhotograph], *, oracle: bool = False
) -> None:
    """Write photographs into the folder; those of another camera or a moved target apart.

    For the oracle, counts of another camera are straightened. Their noise remains.
    """
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
            draw = _straight(power) if oracle else demo_field._draw
            with (
                mock.patch.object(demo_field, "Srgb", lambda power=power: _Bent(power)),
                mock.patch.object(demo_field, "_draw", draw),
            ):
                demo_field.write_photographs(root, plant, some)


def _straight(power: float) -> Callable[..., NDArray[np.uint8]]:
    """Draws photographs whose counts get the inverse of a power."""
    draw, counts = demo_field._draw, np.arange(256) / 255
    straightened = np.round(255 * counts ** (1 / power)).astype(np.uint8)
    return lambda light, rng: straightened[draw(light, rng)]


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


def fill(root: Path, store: Path, case: Case, *, oracle: bool = False) -> None:
    """Import a part, make surfaces and mounts, and receive the rest one by one.

    The oracle refines the surfaces that the robot refines, from all photographs.
    """
    end = max(one.taken_at for one in case.photographs)
    begin, unseen = (end - timedelta(days=days) for days in (ARCHIVED, UNSEEN))
    older = [one for one in case.photographs if one.taken_at < begin]
    newer = [one for one in case.photographs if begin <= one.taken_at < unseen]
    lacking = {name for one in case.faults if one.kind == "no surface" for name in one.heliostats}
    write(root, case, older, oracle=oracle)
    with service_on(store) as (client, runtime):
        import_folder(runtime, read_folder(root, sorted(case.plant.heliostats)), actor="robot")
        names = sorted(set(case.plant.heliostats) - lacking)
        sent(client, "POST", "/v1/jobs/predictions", {"heliostats": names, "images": 8})
        sent(client, "POST", "/v1/jobs/calibrations", {})
        work(runtime)
        write(root, case, newer, oracle=oracle)
        give(runtime, root, newer)
        faulty = sorted(
            {name for one in case.faults if one.kind in REMADE for name in one.heliostats}
        )
        if oracle and faulty:
            refined = {"heliostats": faulty, "method": "refined"}
            sent(client, "POST", "/v1/jobs/predictions", refined)
        work(runtime)


def give(runtime: Runtime, root: Path, photographs: Sequence[PlannedPhotograph]) -> list[Any]:
    """Send photographs, as a calibration system does; what is stored of each."""
    folder = read_folder(root, sorted({one.mirror.name for one in photographs}))
    wanted, rows = {str(one.number) for one in photographs}, []
    for name in sorted({one.mirror.name for one in photographs}):
        for one in folder.measurements(name):
            if one.external_id in wanted:
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
    """The first offer for each alarm, of its common cause, itself or its heliostat.

    Heliostats without a surface need no alarm; the page of the field lists them.
    """
    common = client.get("/v1/alarms/causes").json()["items"]
    found: dict[str, tuple[str | None, dict[str, Any]]] = {}
    for alarm in client.get("/v1/alarms", params={"limit": 500}).json()["items"]:
        name, offer = alarm["heliostat"], alarm["offer"]
        shared = [one for one in common if alarm["id"] in one["ids"]]
        if shared:
            name, offer = None, shared[0]["offer"]
        elif offer is None and name is not None:
            offer = first_offer(client, name)
        if offer is not None:
            found.setdefault(str(offer), (name, offer))
    for one in client.get("/v1/heliostats", params={"limit": 500}).json()["items"]:
        name = one["name"]
        answer = client.get(f"/v1/heliostats/{name}/surfaces/current")
        if answer.status_code == 404 and (offer := first_offer(client, name)) is not None:
            found.setdefault(str(offer), (name, offer))
    return list(found.values())


def first_offer(client: TestClient, name: str) -> dict[str, Any] | None:
    """What the likeliest cause of a heliostat offers that offers something."""
    causes = client.get(f"/v1/heliostats/{name}/causes").json()["items"]
    return next((one["offer"] for one in causes if one["offer"]), None)


class Action(NamedTuple):
    """What was done, its gain [1] for its heliostat or the field, and the worst of both."""

    label: str
    gain: float
    worst: float


def run_shift(
    store: Path, unseen: Path, photographs: Sequence[PlannedPhotograph], most: int, until_s: float
) -> tuple[list[Action], dict[str, float]]:
    """Take offers until none is left or the time is over; with each model an offer is another.

    Returns the change of accuracy [1] by each, and the accuracies at the end.
    """
    done, changes = set[str](), list[Action]()
    before = judge(store, unseen, photographs)
    while len(changes) < most and time.monotonic() < until_s:
        with service_on(store) as (client, runtime):
            model = client.get("/v1/models/current").json()["version"]
            left = [one for one in offers(client) if str((model, one)) not in done]
            if not left:
                break
            name, offer = left[0]
            done.add(str((model, left[0])))
            sent(client, offer["method"], offer["path"], offer["body"])
            work(runtime)
        if offer["path"].startswith("/v1/studies/"):  # the page of a heliostat offers it, too
            name = None
        some = [one for one in photographs if name is None or one.mirror.name == name]
        after = before | judge(store, unseen, some)
        gains = {one: after[one] - before.get(one, 0.0) for one in after}
        change = mean(after.values()) - mean(before.values())
        label = f"{name or 'plant'}: {offer['label']}"
        worst = min(change, gains[name]) if name in gains else change
        changes.append(Action(label, gains.get(name or "", change), worst))
        done_at = f"{datetime.now():%H:%M:%S} {store.parent.name}"
        print(f"{done_at} {100 * changes[-1].gain:+.2f} points  {label}", flush=True)
        before = after
    return changes, before


# --- what is right at the end
# --------------------------------------------------------------------------------------------------

_BETWEEN = re.compile(r"between (\S+ \S+) UTC and (\S+ \S+) UTC")
_DATED = {
    "facet canted": "fell",
    "camera changed": "fell",
    "hazy": "fell",
    "soiled": "dimmed",
    "drives stepped": "moved",
    "target moved": "moved",
}


def dates(client: TestClient, case: Case) -> list[bool]:
    """Whether the interval of each dated alarm holds the first photograph after a change.

    Two faults may move the spots of a heliostat, such as its drives and the target. What falls in
    the whole field has a fault of the field.
    """
    found = []
    for alarm in client.get("/v1/alarms", params={"limit": 500}).json()["items"]:
        name = alarm["heliostat"]
        firsts = [
            first_of(case, fault, name)
            for fault in case.faults
            if _DATED.get(fault.kind) == alarm["reason"]
            and (not fault.heliostats or name in fault.heliostats)
        ]
        if firsts:
            ends = _BETWEEN.search(alarm["message"])
            assert ends is not None, alarm["message"]
            begin, end = (datetime.fromisoformat(f"{one}+00:00") for one in ends.groups())
            found.append(any(begin < one < end + timedelta(minutes=1) for one in firsts))
    return found


def first_of(case: Case, fault: Fault, name: str | None) -> datetime:
    """When the first photograph of a heliostat, or of any, was taken that a fault acts on."""
    return min(
        one.taken_at
        for one in case.photographs
        if fault.kind in one.faults and name in (None, one.mirror.name)
    )


def right(client: TestClient, case: Case, fault: Fault) -> bool:
    """Whether a fault ends with the right state: surface, effect, mount, times, exclusions."""
    listed = client.get("/v1/alarms", params={"limit": 500}).json()["items"]
    names = fault.heliostats or tuple(case.plant.heliostats)
    alarms = {
        one["reason"] for one in listed if one["heliostat"] in names and not one["acknowledged_by"]
    }
    uncalibrated = [one for one in listed if one["heliostat"] in names and one["offer"]]
    effects = client.get("/v1/models/current").json()["effects"]
    now_acting = [one for one in effects if not (one.get("scope") or {}).get("until")]
    epochs = {name: epoch for name in names if (epoch := _epoch(client, name))}
    canted = {name for one in case.faults if one.kind == "facet canted" for name in one.heliostats}
    match fault.kind:
        case "facet canted":
            begun = epochs.get(names[0])
            first = first_of(case, fault, names[0])
            is_known = any(one["name"] == "facet_canting" for one in now_acting)
            return is_known or (begun is not None and abs(begun - first) < timedelta(days=3))
        case "soiled":
            return "dimmed" not in alarms and not epochs
        case "drives stepped" | "drifting" | "target moved":
            return not [one for one in uncalibrated if one["reason"] in ("moved", "pointing")]
        case "clock":
            return "sun_contradicts_time" not in alarms
        case "neighbour":
            path = f"/v1/heliostats/{names[0]}/measurements"
            stored = client.get(path, params={"limit": 500}).json()["items"]
            out = {one["id"] for one in stored if one["reason"] == "excluded"}
            photographs = [one for one in case.photographs if one.mirror.name == names[0]]
            return out == {str(one.number) for one in photographs if "neighbour" in one.faults}
        case "no surface":
            answer = client.get(f"/v1/heliostats/{names[0]}/surfaces/current")
            return bool(answer.status_code == 200)
        case "hazy":
            return not epochs.keys() - canted and not [
                one
                for one in now_acting
                if one["name"] in ("sun_shape", "slope_error", "camera_blur")
            ]
        case "camera changed":
            begins = [
                datetime.fromisoformat(f"{one['scope']['since']}T12:00:00+00:00")
                for one in now_acting
                if one["name"].startswith("camera_") and one.get("scope")
            ]
            first = first_of(case, fault, None)
            is_dated = any(abs(begun - first) < timedelta(days=3) for begun in begins)
            return not epochs.keys() - canted and is_dated
    raise ValueError(fault.kind)


def _epoch(client: TestClient, name: str) -> datetime | None:
    """Since when the active surface's epoch is."""
    answer = client.get(f"/v1/heliostats/{name}/surfaces/current")
    since = answer.json().get("epoch_since") if answer.status_code == 200 else None
    return None if since is None else datetime.fromisoformat(since)


@dataclass
class Result:
    """What the fields of a strength show."""

    actions: list[Action] = field(default_factory=list)
    rights: list[tuple[str, bool]] = field(default_factory=list)
    dates: list[bool] = field(default_factory=list)
    gains: list[float] = field(default_factory=list)
    gaps: list[float] = field(default_factory=list)

    def add(self, other: "Result") -> None:
        """Add what other fields of the strength show."""
        for one in fields(self):
            getattr(self, one.name).extend(getattr(other, one.name))

    def log(self, word: str) -> None:
        """Log the row of a strength."""
        bad = [one for one in self.actions if one.worst < -WORSE]
        are_right = [is_right for _, is_right in self.rights]
        cells = {
            "actions": len(self.actions),
            "of them made unseen photographs worse": len(bad),
            "faults with the right state [%]": proportion(sum(are_right), len(are_right))
            if are_right
            else None,
            "dates in their interval [%]": proportion(sum(self.dates), len(self.dates))
            if self.dates
            else None,
            "gain [points]": 100 * mean(self.gains),
            "below the oracle [points]": 100 * mean(self.gaps),
        }
        log_row("A robot takes what alarms offer", word, cells, n=len(self.gains), of="fields")


def try_field(options: argparse.Namespace, seed: int, word: str) -> Result:
    """What the robot shows on a field."""
    with tempfile.TemporaryDirectory(prefix=f"{word}-{seed}-") as folder:
        return _try_field(Path(folder), options, seed, word)


def _try_field(root: Path, options: argparse.Namespace, seed: int, word: str) -> Result:
    strength = {"strong": 0, "weak": 1, "none": None}[word]
    size = (seed, strength, options.heliostats, options.each)
    case = make_case(root / "plant", *size)
    end = max(one.taken_at for one in case.photographs)
    later = [one for one in case.photographs if one.taken_at >= end - timedelta(days=UNSEEN)]
    fill(root / "plant", root / "store", case)
    shutil.copytree(root / "plant", root / "unseen")
    write(root / "unseen", case, later)
    begun = judge(root / "store", root / "unseen", later)
    with service_on(root / "store") as (client, _):
        dated = dates(client, case)
    until_s = time.monotonic() + 60 * options.minutes
    made, ended = run_shift(root / "store", root / "unseen", later, options.most, until_s)
    with service_on(root / "store") as (client, _):
        found = [(one.kind, right(client, case, one)) for one in case.faults]
    print(
        f"{word}, seed {seed}:", ", ".join(f"{k} {'right' if ok else 'wrong'}" for k, ok in found)
    )
    ideal = make_case(root / "ideal", *size, oracle=True)
    fill(root / "ideal", root / "oracle", ideal, oracle=True)
    known = [one for one in ideal.photographs if one.taken_at >= end - timedelta(days=UNSEEN)]
    write(root / "ideal", ideal, known, oracle=True)
    best = judge(root / "oracle", root / "ideal", known)
    gain = mean(ended.values()) - mean(begun.values())
    gap = mean(best.values()) - mean(ended.values())
    for name in sorted(ended, key=lambda one: ended[one] - best.get(one, 0.0))[:MOST_BELOW]:
        kinds = ", ".join(one.kind for one in case.faults if name in one.heliostats)
        print(f"{word}, seed {seed}: {name} {100 * (best[name] - ended[name]):.2f} below: {kinds}")
    return Result(made, found, dated, [gain], [gap])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--heliostats", type=int, default=60)
    parser.add_argument("--each", type=int, default=24, help="photographs of a heliostat")
    parser.add_argument("--most", type=int, default=60, help="actions of a field")
    parser.add_argument("--minutes", type=float, default=60, help="time of a field's actions")
    parser.add_argument("--jobs", type=int, default=1, help="fields at a time")
    parser.add_argument("--strengths", nargs="+", default=["strong", "weak", "none"])
    options = parser.parse_args()
    results = {word: Result() for word in options.strengths}
    seeds = range(options.first_seed, options.first_seed + options.seeds)
    with ProcessPoolExecutor(options.jobs, mp_context=get_context("spawn")) as pool:
        work = {
            pool.submit(try_field, options, seed, word): word
            for seed in seeds
            for word in options.strengths
        }
        for done in as_completed(work):
            results[work[done]].add(done.result())
            with recording("shift"):
                for word, result in results.items():
                    if result.gains:
                        result.log(word)
    for word, result in results.items():
        for action in result.actions:
            print(f"{word}: {100 * action.gain:+.2f} points  {action.label}")
        for kind in dict.fromkeys(kind for kind, _ in result.rights):
            are_right = [is_right for one, is_right in result.rights if one == kind]
            print(f"{word}: {kind}: {sum(are_right)} of {len(are_right)} right")


if __name__ == "__main__":
    main()
