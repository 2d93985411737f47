"""Any store survives an export and its import: actions of pages and REST in any order."""

import json
import random
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient
from hypothesis import Phase, given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from service import store
from service.base.settings import Settings
from service.store.mounts import add_mount
from service.store.surface_versions import NewSurface
from service.store.tables import UNLIKE_HELIOSTAT
from service.twin.runtime import Runtime
from service.web.app import create_app
from tests.service import exported, real
from tests.service.conftest import (
    QUIET,
    FakeOperations,
    client_of,
    metadata,
    png,
    poster,
    properties_document,
    spot_of,
    sun_at,
    tower_document,
)
from tests.service.spots import photographs
from tests.service.studies import GAMMA, SLOPE, study_row
from tests.service.twin.test_exporting import mount_document

NAMES = ("AA39", "AB01", "W1")
"""Two of PAINT's heliostats, and one of three facets."""
FACETS = {"rows": 1, "columns": 3, "width_m": 1.5, "height_m": 2, "gap_m": 0.01}
W1 = {
    "type": {"mount": {"kind": "pitch_roll", "pivot_height_m": 2}, "facets": FACETS},
    "east_m": 10,
    "north_m": 150,
    "up_m": 0,
}
PLANE = {"center": [0, -3.2, 35.9], "normal": [0, 1, 0], "width": 8.6, "height": 7.2}
RECEIVERS: tuple[dict[str, Any], ...] = (
    {"center": [0, -3, 55.2], "normal": [0, 1, 0], "radius": 4.1, "height": 5.2, "opening_deg": 60},
    {"kind": "plane", **PLANE, "absorptance": 0.9},
)
CAMERA = {"corners_px": [[100, 80], [900, 90], [110, 700], [890, 690]]}
MOMENTS = ("2024-06-03T11:30:00Z", "2024-06-04T09:00:00.25Z", "2023-12-01T10:15:00+02:00", None)
WHY = {"reason": 'to try: é, "quoted"'}


class AnyFacets(FakeOperations):
    """Predicts mirrors of any number of facets, the third time with warnings."""

    def predict(self, heliostat: Any, *arguments: Any, **options: Any) -> Any:
        made = super().predict(heliostat, *arguments, **options)
        z = np.linspace(-1e-3, 1e-3, 64 * len(heliostat.facets)).reshape(-1, 8, 8)
        object.__setattr__(made, "z", z)
        object.__setattr__(made, "z_std", np.full_like(z, 1e-4))
        object.__setattr__(made, "control_points", np.stack([z, z, z], axis=-1))
        if len(self.predictions) % 3 == 0:
            object.__setattr__(made, "warnings", ("it is unlike other mirrors",))
        return made


class Plant:
    """A service, and what is done with it; ``random`` chooses."""

    def __init__(self, client: TestClient, choose: random.Random) -> None:
        self.client, self.random = client, choose
        self.runtime: Runtime = client.app.state.runtime  # type: ignore[attr-defined]
        self.n_photographs = 0

    def name(self) -> str:
        return self.random.choice(NAMES)

    def maybe(self, value: Any) -> Any:
        return self.random.choice((value, None))

    def photograph(self, name: str) -> str:
        """The id of a photograph, of an alias, or of none."""
        path = f"/v1/heliostats/{name}/measurements"
        items = self.client.get(path, params={"limit": 500}).json()["items"]
        return str(self.random.choice([item["id"] for item in items] or ["none"]))

    def version(self, name: str) -> int:
        items = self.client.get(f"/v1/heliostats/{name}/surfaces").json()["items"]
        return int(self.random.choice([item["version"] for item in items] or [1]))

    def require(self, answer: Any) -> None:
        """An action may be refused, but nothing breaks."""
        assert answer.status_code < 500, answer.text


def known_of(plant: Plant) -> dict[str, Any]:
    """Metadata of a photograph, some of it missing."""
    choose = plant.random
    known = {
        "id": plant.maybe(choose.choice(("1", "2", "one", f"n-{plant.n_photographs}"))),
        "taken_at": choose.choice(MOMENTS),
        "motor_position": plant.maybe([choose.randint(0, 60_000) + 0.5, 45012]),
        "focal_spot_m": plant.maybe(spot_of(50.9136, 6.3879, 120 + choose.random())),
        "helios_spot_m": plant.maybe(spot_of(50.9137, 6.3878, 123.5)),
        "wind_speed_m_s": plant.maybe(3.5),
        "temperature_c": plant.maybe(-2.25),
        "sun": sun_at(round(choose.uniform(90, 270), 3), round(choose.uniform(10, 60), 3)),
        "target": choose.choice(("lower", "upper")),
        "kind": choose.choice(("flux", "cropped", "raw", "flux-centered")),
    }
    return {name: value for name, value in known.items() if value is not None}


def send_photograph(plant: Plant) -> None:
    plant.n_photographs += 1
    image = png(plant.n_photographs, refused=plant.random.random() < 0.2)
    plant.require(poster(plant.client)(image, plant.name(), **known_of(plant)))


def send_again(plant: Plant) -> None:
    """A known image, with other metadata, perhaps at another heliostat."""
    seed = plant.random.randint(1, max(1, plant.n_photographs))
    forced = {"force": True, "reason": "of both"} if plant.random.random() < 0.5 else {}
    plant.require(poster(plant.client)(png(seed), plant.name(), **known_of(plant), **forced))


def send_position(plant: Plant) -> None:
    known = known_of(plant) | {"kind": "none", "motor_position": [1000.0, 2000.0]}
    known["focal_spot_m"] = spot_of(50.9136, 6.3879, 120 + plant.random.randint(0, 2))
    path = f"/v1/heliostats/{plant.name()}/measurements"
    document = json.dumps(metadata(**known))
    plant.require(plant.client.post(path, files={"metadata": (None, document)}))


def correct(plant: Plant) -> None:
    known = known_of(plant)
    fields = ("taken_at", "sun", "target", "motor_position", "wind_speed_m_s")
    changes = {name: known[name] for name in fields if name in known and plant.maybe(True)}
    changes |= plant.random.choice(({}, {"excluded": True}, {"excluded": False}))
    name = plant.name()
    path = f"/v1/heliostats/{name}/measurements/{plant.photograph(name)}"
    plant.require(plant.client.patch(path, json=changes | WHY))


def exclude(plant: Plant) -> None:
    name = plant.name()
    form = {"photographs": plant.photograph(name), "excluded": plant.random.choice("01")} | WHY
    plant.require(plant.client.post(f"/heliostats/{name}/exclusions", data=form))


def delete(plant: Plant) -> None:
    name = plant.name()
    path = f"/v1/heliostats/{name}/measurements/{plant.photograph(name)}"
    asked = WHY | {"only_this": plant.random.choice(("true", "false"))}
    plant.require(plant.client.delete(path, params=asked))


def give_times(plant: Plant) -> None:
    name = plant.name()
    entry = {"heliostat": name, "id": plant.photograph(name), "taken_at": MOMENTS[0]}
    plant.require(plant.client.patch("/v1/measurements/times", json={"times": [entry], **WHY}))


def give_motors(plant: Plant) -> None:
    name = plant.name()
    form = {"what": "motors", "lines": f"{name},{plant.photograph(name)},30000,40000"} | WHY
    plant.require(plant.client.post("/photographs/times", data=form))


def undo_batch(plant: Plant) -> None:
    number = plant.random.randint(1, 40)
    plant.require(plant.client.post(f"/photographs/times/{number}/undo"))


def predict(plant: Plant) -> None:
    name = plant.name()
    asked: dict[str, Any] = {"method": plant.random.choice(("network", "refined"))}
    if plant.random.random() < 0.5:
        asked["measurements"] = [plant.photograph(name)]
    plant.require(plant.client.post(f"/v1/heliostats/{name}/surfaces", json=asked))


def measure_surface(plant: Plant) -> None:
    name = plant.name()
    with plant.runtime.database.writing() as session:
        row = store.get_heliostat(session, name)
        z = np.random.default_rng(plant.random.randint(0, 2)).normal(
            0, 3e-4, (3 if name == "W1" else 4, 8, 8)
        )
        points = np.stack([z, z, z], axis=-1)
        store.add_surface(session, row, NewSurface("measured", z, 0 * z, points), once=True)


def choose_surface(plant: Plant) -> None:
    name = plant.name()
    what = plant.random.choice(("take", "keep", "acknowledge"))
    path = f"/heliostats/{name}/surfaces/{plant.version(name)}/{what}"
    plant.require(plant.client.post(path, data=WHY))


def undo_decision(plant: Plant) -> None:
    plant.require(plant.client.post(f"/v1/heliostats/{plant.name()}/surfaces/undo"))


def set_mount(plant: Plant) -> None:
    """A mount from photographs, none of which may have a time."""
    document = mount_document("2024-06-03T11:30:00+00:00")
    if plant.random.random() < 0.5:
        document |= {"valid_from": None, "history": document["history"] | {"at": [None]}}
    with plant.runtime.database.writing() as session:
        add_mount(session, store.get_heliostat(session, plant.name()), document)


def warn(plant: Plant) -> None:
    """A photograph that was like another heliostat's when it came."""
    with plant.runtime.database.writing() as session:
        row = store.get_heliostat(session, plant.name())
        for photograph in store.list_measurements(session, row, 1):
            warning = {"type": UNLIKE_HELIOSTAT, "detail": "unlike AA39, like AB01", "like": "AB01"}
            others = [one for one in photograph.warnings or () if one["type"] != UNLIKE_HELIOSTAT]
            photograph.warnings = [*others, warning]


def study(plant: Plant) -> None:
    effects = plant.random.choice(((), (SLOPE,), (GAMMA,), (SLOPE, GAMMA)))
    with plant.runtime.database.writing() as session:
        number = store.add_study(session, study_row(*effects)).id
    for what in plant.random.choice(((), ("adopt",), ("adopt", "withdraw"))):
        body = WHY | ({"force": True} if what == "adopt" else {})
        plant.require(plant.client.post(f"/v1/studies/{number}/{what}", json=body))


def declare(plant: Plant) -> None:
    sun = plant.random.choice(
        ({"shape": "pillbox", "half_angle_mrad": 4.65}, {"shape": "buie", "chi": 0.03})
    )
    declared = {"sun": sun} | plant.random.choice(({}, {"cameras": [{"transfer": {"gamma": 2.0}}]}))
    size = plant.random.choice(({}, {"tower_size": {"radius_m": 4.0, "height_m": 50.0}}))
    document = tower_document() | {"declared": declared} | size
    plant.require(plant.client.put("/v1/plant", json=document))


def set_receiver(plant: Plant) -> None:
    document = plant.random.choice(RECEIVERS)
    path = f"/v1/receivers/{plant.random.choice(('drum', 'board'))}"
    plant.require(plant.client.put(path, json=document))


def set_target(plant: Plant) -> None:
    marks = plant.random.choice(({}, {"marks": "l_brackets"}, {"camera": CAMERA}))
    path = f"/v1/targets/{plant.random.choice(('screen', 'upper'))}"
    plant.require(plant.client.put(path, json={"plane": PLANE, **marks}))


def remove(plant: Plant) -> None:
    path = plant.random.choice(("receivers/drum", "targets/screen", "heliostats/W1"))
    plant.require(plant.client.delete(f"/v1/{path}"))
    plant.client.put("/v1/heliostats/W1", json=W1)


def measure_again(plant: Plant) -> None:
    """The job `measurements`, with the present camera."""
    if plant.client.post("/v1/jobs/measurements", json=WHY).status_code == 202:
        assert real.worker(plant.client).work()


ACTIONS: tuple[Callable[[Plant], None], ...] = (
    send_photograph,
    send_photograph,
    send_again,
    send_position,
    correct,
    exclude,
    delete,
    give_times,
    give_motors,
    undo_batch,
    predict,
    measure_surface,
    choose_surface,
    undo_decision,
    set_mount,
    warn,
    study,
    declare,
    set_receiver,
    set_target,
    remove,
    measure_again,
)


def round_trip(actions: list[Callable[[Plant], None]], seed: int) -> None:
    folder = Path(tempfile.mkdtemp())
    try:
        operations = AnyFacets()
        options = Settings(data_dir=folder / "data", **QUIET)
        with client_of(create_app(options, operations)) as client:
            client.put("/v1/plant", json=tower_document())
            for name in NAMES:
                document = W1 if name == "W1" else properties_document()
                assert client.put(f"/v1/heliostats/{name}", json=document).status_code == 201
            plant = Plant(client, random.Random(seed))
            for action in actions:
                action(plant)
            exported.require_round_trip(plant.runtime, operations, folder)
    finally:
        shutil.rmtree(folder)


def test_store_of_every_action_is_the_same_after_export_and_import():
    round_trip([*[send_photograph] * 6, *ACTIONS, predict, send_photograph], 2)


@pytest.mark.full
@hypothesis_settings(max_examples=25, deadline=None, phases=[Phase.generate])
@given(st.lists(st.sampled_from(ACTIONS), max_size=30), st.integers(0, 2**16))
def test_any_store_is_the_same_after_export_and_import(
    actions: list[Callable[[Plant], None]], seed: int
):
    round_trip([send_photograph, send_photograph, *actions], seed)


def test_what_an_export_leaves_out_is_documented():
    """Every table is compared, or named on the page of the files, and so is every column."""
    page = (Path(__file__).parents[3] / "docs" / "reference" / "file-formats.md").read_text()
    section = page.partition("(export)=")[2].partition("\n(")[0]
    for table, columns in exported.NOT_EXPORTED.items():
        names = {f"`{table}`"} | {f"`{column}`" for column in columns - exported.ALL}
        assert [name for name in names if name not in section] == []
    measured = exported.MEASURED_AGAIN - {"warnings"}  # that of the arrival is exported
    assert [name for name in measured if f"`{name}`" not in section] == []


@pytest.mark.full
def test_mount_of_undated_photographs_goes_through_an_export(
    client: TestClient, tower: Any, properties: Any, tmp_path: Path
):
    """The import skipped the history for it, with the surface."""
    for seed, known in enumerate(photographs(tower, properties)):
        poster(client)(png(seed), **known | {"taken_at": None})
    assert client.post("/v1/heliostats/AA39/surfaces", json={}).status_code == 201
    assert real.run_job(client, "/v1/jobs/calibrations")["mounts"] == {"AA39": 1}
    exported.require_round_trip(real.runtime_of(client), FakeOperations(), tmp_path)


@pytest.mark.full
def test_real_store_goes_through_an_export(real_client: TestClient, tmp_path: Path):
    """Its photographs were measured before a study was adopted and withdrawn."""
    exported.require_round_trip(
        real.runtime_of(real_client), None, tmp_path, exported.MEASURED_AGAIN
    )
