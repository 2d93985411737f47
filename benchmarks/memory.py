"""Memory of the service under the largest inputs that it accepts: ``python -m
benchmarks.memory``.

Starts the real service on a store of 20,000 heliostats and of two real mirrors of the Solar Tower
Juelich. Sends one input after the other, waits for its answer or for the end of its job, and prints
the peak of each: the service's (``VmHWM``, which is reset before), and its child processes' with
the memory that they share with it. No sum may pass 2.5 GB (2500 MB). ``--only WORD ..`` sends those
whose names have one of these words, and records them in ``results/memory-WORD-...json``.

``--pages STORE`` reads the pages of a store for two minutes instead, such as those of ``heliotwin
demo`` in ``out/demo/store-field``, and prints the memory before, meanwhile and after
(``results/memory-pages.json``). Linux only.
"""

import argparse
import io
import json
import re
import struct
import sys
import tempfile
import threading
import time
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any, Self

import cv2
import h5py
import httpx
import numpy as np
from PIL import Image

from benchmarks import data_folder, field
from benchmarks.load import import_two
from benchmarks.record import Estimate, log_row, recording
from service.sources.files import MAX_JSON_VALUES
from service.store.database import Database, migrate
from tests.faults.harness import Process, Store, new_store
from tests.service.conftest import metadata_of

BOUND_MB = 2500.0
PIXELS = 50_000_000
SIDE = int(PIXELS**0.5)
TARGET = "multi_focus_tower"
SUN = {"azimuth_deg": 200.0, "elevation_deg": 45.0}
MEASUREMENT = {"target": TARGET, "sun": SUN}
JOB_LIMIT_S, ENDLESS_S = 900.0, 300.0
"""Seconds after which a job is cancelled, and one whose parts all take the same memory."""


class MemoryWatch:
    """Peaks of a process and its children [MB] while the block runs."""

    def __init__(self, number: int) -> None:
        self.number = number
        self.service = 0.0
        self._children: dict[int, float] = {}
        self._shared = 0.0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch)

    def __enter__(self) -> Self:
        for number in (self.number, *_children(self.number)):
            with suppress(OSError):
                Path(f"/proc/{number}/clear_refs").write_text("5")  # VmHWM becomes VmRSS
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        self.service = _status_mb(self.number, "VmHWM")

    @property
    def children(self) -> float:
        """The sum of the children's peaks, with the memory that they share with the service."""
        return sum(self._children.values()) + self._shared

    def _watch(self) -> None:
        while not self._stop.wait(0.02):
            numbers = _children(self.number)
            for number in numbers:
                with suppress(OSError):
                    self._children[number] = max(
                        self._children.get(number, 0.0), _status_mb(number, "VmHWM")
                    )
            self._shared = max(self._shared, sum(map(_shared_mb, numbers)))


def _children(number: int) -> list[int]:
    """Process ids of all descendants."""
    found: list[int] = []
    with suppress(OSError):
        for task in Path(f"/proc/{number}/task").iterdir():
            for child in (task / "children").read_text().split():
                found += [int(child), *_children(int(child))]
    return found


def _status_mb(number: int, what: str) -> float:
    lines = Path(f"/proc/{number}/status").read_text().splitlines()
    return next(
        (int(line.split()[1]) / 1000 * 1.024 for line in lines if line.startswith(what)), 0.0
    )


def _shared_mb(number: int) -> float:
    """Size [MB] of the files in memory that a decoder and the service share."""
    total = 0
    with suppress(OSError):
        for file in Path(f"/proc/{number}/fd").iterdir():
            with suppress(OSError):
                if "memfd:" in str(file.readlink()):
                    total += 512 * file.stat().st_blocks
    return total / 1e6


# --- photographs
# --------------------------------------------------------------------------------------------------


def spot(depth: type[np.uint8 | np.uint16]) -> Any:
    """A bright spot of (SIDE, SIDE, 3)."""
    half = np.hanning(SIDE)
    gray = np.outer(half**8, half**8) * np.iinfo(depth).max
    return np.repeat(gray.astype(depth)[..., None], 3, axis=2)


def tiff() -> bytes:
    return cv2.imencode(".tiff", spot(np.uint16), [cv2.IMWRITE_TIFF_COMPRESSION, 8])[1].tobytes()


def png() -> bytes:
    pixels = spot(np.uint16)
    compressed = [cv2.IMWRITE_PNG_COMPRESSION, 6]  # the service accepts files of 32 MiB
    return cv2.imencode(".png", np.dstack([pixels, pixels[..., :1]]), compressed)[1].tobytes()


def jpeg() -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(spot(np.uint8)).save(buffer, "jpeg", progressive=True, quality=90)
    return buffer.getvalue()


def tiff_of_many_tags() -> bytes:
    """A million bytes, and a thousand tags that claim all of them."""
    entries = b"".join(struct.pack("<HHII", 1000 + tag, 1, 10**6, 8) for tag in range(1000))
    return (
        b"II*\x00"
        + struct.pack("<I", 8 + 10**6)
        + bytes(10**6)
        + struct.pack("<H", 1000)
        + entries
        + bytes(4)
    )


Send = Callable[[httpx.Client], Any]


def photograph(image: Callable[[], bytes], kind: str, times: int = 1) -> Send:
    """A post of a photograph, ``times`` of them at once; each is another image by its last bytes or
    metadata.
    """

    def send(http: httpx.Client) -> str:
        data = image()

        def post(number: int) -> str:
            # Another heliostat each, so that none is a repetition of the one before.
            path = f"/v1/heliostats/H{number:05d}/measurements"
            about = MEASUREMENT | {"kind": kind, "force": True, "reason": "benchmark"}
            answer = http.post(
                path, files={"image": ("image", data)}, data={"metadata": json.dumps(about)}
            )
            return said(answer)

        first = next(_NUMBERS)
        with ThreadPoolExecutor(times) as pool:
            return "; ".join(pool.map(post, range(first, first + times)))

    return send


def _numbers() -> Iterator[int]:
    number = 100
    while True:
        yield number
        number += 10


_NUMBERS = _numbers()


def said(answer: httpx.Response) -> str:
    """Status, size and the first words of an answer that is an error."""
    text = f"{answer.status_code}, {len(answer.content) / 1e6:.1f} MB"
    return text if answer.status_code < 400 else f"{text}: {answer.json().get('detail', '')[:90]}"


# --- requests
# --------------------------------------------------------------------------------------------------


def forecast(**changes: Any) -> Send:
    """A forecast in each representation."""

    def send(http: httpx.Client) -> str:
        body = {"heliostat": "AA39", "target": TARGET, "sun": SUN, "resolution": 1024} | changes
        answer = http.post(
            "/v1/forecasts", json={name: value for name, value in body.items() if value is not None}
        )
        if answer.status_code >= 400:
            return said(answer)
        where = answer.headers["Location"]
        return "; ".join(
            said(http.get(where, headers={"Accept": kind}))
            for kind in ("application/json", "application/x-npz", "image/png")
        )

    return send


def plane(width: float, height: float) -> dict[str, Any]:
    flat = {"center": [0.0, 0.0, 40.0], "normal": [0.0, 1.0, 0.0], "up": [0.0, 0.0, 1.0]}
    return flat | {"width": width, "height": height}


def cylinder(radius: float, height: float, opening_deg: float) -> dict[str, Any]:
    return {
        "center": [0.0, 0.0, 40.0],
        "normal": [0.0, 1.0, 0.0],
        "radius": radius,
        "height": height,
        "opening_deg": opening_deg,
    }


def get(*paths: str) -> Send:
    return lambda http: "; ".join(
        said(http.get(path, headers={} if "/v1/" in path else {"Accept": "text/html"}))
        for path in paths
    )


def document(body: Callable[[], bytes]) -> Send:
    return lambda http: said(
        http.post(
            "/v1/jobs/predictions", content=body(), headers={"Content-Type": "application/json"}
        )
    )


# --- jobs
# --------------------------------------------------------------------------------------------------


def job(
    kind: str, pages: tuple[str, ...] = (), limit_s: float = JOB_LIMIT_S, **payload: Any
) -> Send:
    """A job, waited for and cancelled after a limit, and what shows it."""

    def send(http: httpx.Client) -> str:
        answer = http.post(f"/v1/jobs/{kind}", json=payload)
        if answer.status_code != 202:
            return said(answer)
        number, began = answer.json()["id"], time.monotonic()
        while (state := http.get(f"/v1/jobs/{number}").json())["state"] in ("queued", "running"):
            if time.monotonic() - began > limit_s:
                http.post(f"/v1/jobs/{number}/cancel")
                began = time.monotonic()
            time.sleep(0.5)
        shown = [said(http.get(page.format(number))) for page in pages]
        return "; ".join([f"{state['state']} {(state['reason'] or '')[:90]}".strip(), *shown])

    return send


def plan(times: int, resolution: int, heliostats: int) -> Send:
    """A plan of so many times by the minute."""
    names = [f"H{number:05d}" for number in range(heliostats)]
    end = f"2026-06-21T{10 + times // 60:02d}:{times % 60 - 1:02d}:00Z"
    shown = ("/v1/jobs/{}/flux?step=1", "/v1/jobs/{}", "/plans/{}")
    day: dict[str, Any] = {
        "first_at": "2026-06-21T10:00:00Z",
        "last_at": end,
        "step_minutes": 1,
        "target": TARGET,
    }
    return job(
        "plans",
        shown,
        name="large",
        heliostats=names,
        resolution=resolution,
        neighbours=False,
        **day,
    )


def aims(heliostats: int, side: int, times: int = 1, steps: int = 1) -> Send:
    """So many plans of aims at the same time, on square maps, each for another limit."""

    def send(http: httpx.Client) -> str:
        def plan(number: int) -> str:
            minutes = {"first": "12:00", "last": f"12:{steps - 1:02d}", "step_minutes": 1}
            return job(
                "aim-plans",
                ("/v1/jobs/{}/flux", "/jobs/{}"),
                target=TARGET,
                heliostats=[f"H{number:05d}" for number in range(heliostats)],
                resolution=[side, side],
                day={"date": "2026-06-21"} | minutes,
                limit_w_m2=min(5e7, (5 + number) * 1e3 * heliostats),
                neighbours=False,
            )(http)

        with ThreadPoolExecutor(times) as pool:
            return "; ".join(pool.map(plan, range(times)))

    return send


def imported(root: Path, make: Callable[[Path], None]) -> Send:
    """An import of a folder that holds one heliostat and a bad file."""

    def send(http: httpx.Client) -> str:
        folder = Path(tempfile.mkdtemp(dir=root))
        name = "AA39"
        (folder / name).mkdir()
        for part in ("Calibration", "Deflectometry"):
            (folder / name / part).mkdir()
        tower = "WRI1030197-tower-measurements.json"
        (folder / tower).write_bytes((data_folder() / tower).read_bytes())
        (folder / name / "Properties").mkdir()
        for file in (data_folder() / name / "Properties").iterdir():
            (folder / name / "Properties" / file.name).write_bytes(file.read_bytes())
        make(folder / name)
        return job("imports", folder=folder.name)(http)

    return send


def npz_bomb(folder: Path) -> None:
    """5.8 MB that unpack to 6 GB."""
    text = b"{'descr': '<f8', 'fortran_order': False, 'shape': (4, 25000, 2500, 3), }"
    text += b" " * (-(len(text) + 11) % 64) + b"\n"
    name = folder / "Deflectometry" / f"{folder.name}-nurbs-surface.npz"
    with (
        zipfile.ZipFile(name, "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("control_points.npy", "w", force_zip64=True) as member,
    ):
        member.write(b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text)
        for _ in range(600):
            member.write(bytes(10**7))


def h5_bomb(folder: Path) -> None:
    """2.7 kB that declare 10 billion numbers."""
    with h5py.File(folder / "Deflectometry" / f"{folder.name}-deflectometry.h5", "w") as data:
        for facet in range(1, 5):
            data.create_dataset(
                f"facet{facet}/surface_points",
                (10**10, 3),
                "f4",
                chunks=(10**4, 3),
                compression="gzip",
            )


def largest_h5(folder: Path) -> None:
    """As many points of each facet as are read."""
    rng = np.random.default_rng(1)
    with h5py.File(folder / "Deflectometry" / f"{folder.name}-deflectometry.h5", "w") as data:
        for facet in range(1, 5):
            points = np.column_stack([rng.uniform(-1.6, 1.6, (500_000, 2)), np.zeros(500_000)])
            data[f"facet{facet}/surface_points"] = points
            data[f"facet{facet}/surface_normals"] = np.tile([0.0, 0.0, 1.0], (500_000, 1))


def largest_json(folder: Path) -> None:
    """64 MiB, of which as many values as are read are objects of one key, which take the most
    memory.
    """
    objects = [b'{"%x":0}' % number for number in range(MAX_JSON_VALUES // 3 - 1)]
    text = b"[" + b",".join(objects) + b"]"
    text = text[:-1] + b" " * (2**26 - len(text)) + b"]"
    (folder / "Calibration" / "1-calibration-properties.json").write_bytes(text)


def history(text: Callable[[int], bytes]) -> Callable[[Path], None]:
    """Write a heliostat's history of as many values as are read."""

    def make(folder: Path) -> None:
        file = folder.parent / "history" / "heliostats" / folder.name / "history.json"
        file.parent.mkdir(parents=True)
        file.write_bytes(text(MAX_JSON_VALUES // 3 - 10))

    return make


def wrong_photographs(count: int) -> bytes:
    objects = b",".join(b'{"%x":0}' % number for number in range(count))
    return b'{"photographs":[' + objects + b'],"surfaces":[],"decisions":[],"mounts":[]}'


def unknown_keys(count: int) -> bytes:
    return b"{" + b",".join(b'"%x":0' % number for number in range(3 * count // 2)) + b"}"


def inputs(root: Path) -> dict[str, Send]:
    """What is sent, by name, in this order."""
    wide = {"target": None, "plane": plane(1000.0, 50.0)}
    small = {"target": None, "plane": plane(0.2, 0.01)}
    whole = {"target": None, "plane": plane(1000.0, 1000.0)}
    arc = {"target": None, "receiver": cylinder(999.0, 1000.0, 60.0)}
    narrow = {"target": None, "receiver": cylinder(999.0, 5.0, 5.0)}
    own = {"resolution": 1024, "sun": SUN}
    return {
        "nothing": get("/v1/plant"),
        "TIFF of 1000 tags over the same bytes": photograph(tiff_of_many_tags, "flux", 2),
        "TIFF, 50 Mpx, 3 x 16 bit, flux": photograph(tiff, "flux"),
        "TIFF, 50 Mpx, 3 x 16 bit, cropped": photograph(tiff, "cropped"),
        "TIFF, 50 Mpx, 3 x 16 bit, raw": photograph(tiff, "raw"),
        "PNG, 50 Mpx, 4 x 16 bit, flux": photograph(png, "flux"),
        "progressive JPEG, 50 Mpx, flux": photograph(jpeg, "flux"),
        "two TIFFs, 50 Mpx, at once, cropped": photograph(tiff, "cropped", 2),
        "JSON of 50,000 keys": document(
            lambda: b"{" + b",".join(b'"%x":0' % number for number in range(50_000)) + b"}"
        ),
        "JSON of 64 levels": document(lambda: b'{"a":' * 64 + b"0" + b"}" * 64),
        "JSON of 1 MiB of numbers": document(
            lambda: b'{"heliostats":[' + b"0," * (2**19 - 20) + b"0]}"
        ),
        "forecast on a target, 1024 x 1024": forecast(),
        "forecast on a plane of 1000 x 50 m": forecast(**wide),
        "forecast on a plane of 0.2 x 0.01 m": forecast(**small),
        "forecast on a plane of 1000 x 1000 m": forecast(**whole),
        "forecast on a cylinder of 1000 m, 60 deg": forecast(**arc),
        "forecast on a cylinder of 5 m, 5 deg": forecast(**narrow),
        "calibration plan of 20,000 heliostats": get(
            "/v1/calibration-plan?at=2026-06-21T09:00:00Z"
        ),
        "field, alarms and metrics of 20,000": get(
            "/v1/field?limit=500", "/alarms", "/metrics", "/"
        ),
        "plan, 100 x 316 x 316": plan(100, 316, 4),
        "plan, 9 x 1024 x 1024": plan(9, 1024, 20),
        "field forecast, 20,000 mirrors, 1024 x 1024": job(
            "forecasts", ("/v1/jobs/{}/flux", "/jobs/{}"), ENDLESS_S, target=TARGET, **own
        ),
        "aims of 2,650 heliostats, 1024 x 1024": aims(2650, 1024),
        "aims of 2,650 heliostats, 128 x 128": aims(2650, 128),
        "aims of 20,000 heliostats, 44 x 44": aims(20_000, 44),
        "aims of 41 heliostats, 1024 x 1024, twice": aims(41, 1024, times=2, steps=2),
        "import of an npz of 5.8 MB": imported(root, npz_bomb),
        "import of an h5 of declared 10^10 points": imported(root, h5_bomb),
        "import of an h5 of 4 x 500,000 points": imported(root, largest_h5),
        "import of a JSON of 64 MiB": imported(root, largest_json),
        "import of a history of wrong photographs": imported(root, history(wrong_photographs)),
        "import of a history of unknown keys": imported(root, history(unknown_keys)),
        "surfaces of 64 images, refined": job(
            "predictions", heliostats=["AA39"], images=64, method="refined"
        ),
        "study of 2 x 64 images": job("studies", heliostats=["AA39", "AC43"], images=64),
        "study of 6 x 64 images": job("studies", heliostats=list(PHOTOGRAPHED), images=64),
    }


READ_S, READERS, LATER_S = 120.0, 3, 60.0
"""Seconds of reading pages, by so many readers, and seconds after that."""

MOST_ALIKE = 40
"""Pages that a reader opens of those whose paths differ by numbers and names only."""


def read_pages(base: str) -> int:
    """Follow the links of pages for `READ_S`, from the first page again at their end; their
    number.
    """
    until, read = time.monotonic() + READ_S, 0
    with httpx.Client(base_url=base, headers={"Accept": "text/html, */*"}, timeout=60) as http:
        while time.monotonic() < until:
            ahead, alike = ["/"], Counter[str]()
            seen = set(ahead)
            while ahead and time.monotonic() < until:
                answer = http.get(ahead.pop(0))
                read += 1
                for link in re.findall(r'(?:href|src)="(/[^"#]*)"', answer.text):
                    kind = re.sub(r"[A-Z]{2}[0-9]{2}|[0-9]+", "#", link.split("?")[0])
                    alike[kind] += link not in seen
                    if link not in seen and alike[kind] <= MOST_ALIKE:
                        seen.add(link)
                        ahead.append(link.replace("&amp;", "&"))
    return read


def measure_pages(folder: Path) -> None:
    """Print and record the service's memory before, during and after reading a store's pages."""
    store = Store(folder.resolve(), None)
    with Process(store, module="service", HELIOTWIN_JOB_WORKERS="1") as service:
        time.sleep(5)
        found = {"after a start": _status_mb(service.number, "VmRSS")}
        with MemoryWatch(service.number) as memory, ThreadPoolExecutor(READERS) as pool:
            read = sum(pool.map(read_pages, [service.base] * READERS))
        found["highest in two minutes of pages"] = memory.service
        found["at their end"] = _status_mb(service.number, "VmRSS")
        time.sleep(LATER_S)
        found["a minute later"] = _status_mb(service.number, "VmRSS")
    print(f"{read} pages", found)
    for row, value in found.items():
        title = "Memory of the service while the pages of the demonstration are read"
        log_row(title, row, {"service [MB]": value}, n=read, of="pages")


PHOTOGRAPHED = {"AA39": "AA39", "AC43": "AC43"} | {f"H{n:05d}": "AA39" for n in range(4)}
"""Heliostats with 64 photographs, and the real mirror that these are of."""


def prepare(http: httpx.Client) -> None:
    """Make 64 photographs of each mirror from the few real ones, by a little noise."""
    rng = np.random.default_rng(2)
    for name, source in PHOTOGRAPHED.items():
        folder = data_folder() / source / "Calibration"
        files = sorted(folder.glob("*-flux.png"))
        for number in range(64):
            file = files[number % len(files)]
            paint = json.loads(
                (folder / f"{file.name.split('-')[0]}-calibration-properties.json").read_bytes()
            )
            pixels = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
            assert pixels is not None
            noisy = np.clip(pixels + rng.normal(0, 1, pixels.shape), 0, 255).astype(np.uint8)
            paint["sun_azimuth"] += 0.5 * number
            about = metadata_of(paint) | {"kind": "flux", "id": f"n{number}"}
            image = {"image": ("spot.png", cv2.imencode(".png", noisy)[1].tobytes(), "image/png")}
            path = f"/v1/heliostats/{name}/measurements"
            http.post(path, files=image, data={"metadata": json.dumps(about)}).raise_for_status()


def main(arguments: list[str]) -> None:
    """Send each input and print what it took; exit code 1 if one takes more than the bound."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--only",
        nargs="+",
        default=[""],
        help="send the inputs whose names have one of these words",
    )
    parser.add_argument("--heliostats", type=int, default=20_000)
    parser.add_argument("--pages", type=Path, help="read this store's pages", metavar="STORE")
    options = parser.parse_args(arguments)
    if options.pages is not None:
        with recording("memory-pages"):
            measure_pages(options.pages)
        return
    if not data_folder().is_dir():
        parser.error(f"no real measurements at {data_folder()}; set HELIOTWIN_STJ")
    with recording("-".join(["memory", *" ".join(options.only).split()])):
        highest = measure_inputs(options)
    is_below = highest <= BOUND_MB
    word = "below" if is_below else "ABOVE"
    print(f"highest: {highest:.0f} MB, {word} the bound of {BOUND_MB:.0f} MB")
    if not is_below:
        sys.exit(1)


def measure_inputs(options: argparse.Namespace) -> float:
    """Send the chosen inputs; the highest sum [MB]."""
    highest = 0.0
    with tempfile.TemporaryDirectory() as name, new_store("sqlite", Path(name)) as store:
        root = Path(name) / "imports"
        root.mkdir()
        store.folder.mkdir()
        migrate(store.settings)
        database = Database(store.settings.database)
        field.fill(database, options.heliostats)
        database.close()
        import_two(store)
        settings: dict[str, Any] = {
            "HELIOTWIN_JOB_WORKERS": "1",
            "HELIOTWIN_IMPORT_ROOT": str(root),
            "HELIOTWIN_DATABASE_CONNECTIONS": "",
        }
        with (
            Process(store, "serve", module="service", **settings) as service,
            httpx.Client(base_url=service.base, timeout=JOB_LIMIT_S) as http,
        ):
            chosen = {
                what: send
                for what, send in inputs(root).items()
                if any(word in what for word in options.only)
            }
            if any(word in what for what in chosen for word in ("64 images",)):
                prepare(http)
            print(
                f"| {'input':44} | service [MB] | children [MB] | sum [MB] | time [s] | answer |",
                flush=True,
            )
            print(f"| {'-' * 44} | ---: | ---: | ---: | ---: | --- |", flush=True)
            for what, send in chosen.items():
                began = time.monotonic()
                with MemoryWatch(service.number) as memory:
                    answer = send(http)
                total = memory.service + memory.children
                highest = max(highest, total)
                taken_s = time.monotonic() - began
                print(
                    f"| {what:44} | {memory.service:.0f} | {memory.children:.0f} | {total:.0f} |"
                    f" {taken_s:.0f} | {answer} |",
                    flush=True,
                )
                log_row(
                    "Peak memory under the largest inputs",
                    what,
                    {"service and its children [MB]": Estimate(total, goal=f"<= {BOUND_MB:.0f}")},
                )
    return highest


if __name__ == "__main__":
    main(sys.argv[1:])
