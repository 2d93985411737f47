"""The examples of the OpenAPI document: ``python -m tests.openapi_examples`` records them.

The service runs in this process on the demonstration's plant. Each operation is called once for
every answer below 300. Its body and answer go to ``service/web/examples.json``, cut and with fixed
times.
"""

import json
import re
import tempfile
import threading
from collections.abc import Mapping
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from fastapi.testclient import TestClient

from heliotwin.demo.plant import ORIGIN, POSITIONS, TARGET, write_plant
from model.ephemeris import sun_positions
from model.frames import sun_direction
from service.base.settings import Settings
from service.jobs import kind
from service.jobs.kinds import KINDS
from service.jobs.worker import Worker
from service.sources.paint_documents import azimuth_from_north
from service.store import keys
from service.twin.alarms.field_updates import FieldStateWriter
from service.web.app import create_app
from tests.service.archives import zipped

FILE = Path(__file__).parents[1] / "service" / "web" / "examples.json"
KEY = "the-key-of-the-calibration-system"
AT = "2026-07-21T10:00:00Z"
"""Written in place of every moment of the run."""
IMAGES, RAYS = 6, 60_000
CAMERA = {"transfer": {"gamma": 1.5}}
"""What the plant declares of its camera. The photographs have sRGB, so a study finds the rest."""

TIME = re.compile(r"\d{4}-\d{2}-\d{2}T\d{2}:\d{2}:\d{2}(\.\d+)?(Z|\+00:00)?")
RANDOM = re.compile(r"-[0-9a-f]{16}(?![0-9a-f])")
"""Of the name of an upload."""
MAX_TEXT = 1000
PLACES = ("coordinates", "corners", "heliostat_position", "origin_wgs84")


def shorten(value: Any, secrets: Mapping[str, str], since: datetime, place: str = "") -> Any:
    """Cut long parts, round numbers, and replace secrets and the moments of this run."""
    if isinstance(value, dict):
        entries = list(value.items())
        if len(entries) > 2 and all("/" in name for name in value):  # by photograph
            entries = entries[:2]
        return {
            name: shorten(inner, secrets, since, place if place in PLACES else name)
            for name, inner in entries
        }
    if isinstance(value, list):
        most = 1 if value and isinstance(value[0], dict) and place != "facets" else 2
        kept = value if len(value) <= 4 and most > 1 else value[:most]
        return [shorten(inner, secrets, since, place) for inner in kept]
    if isinstance(value, float) and place == "age_days":
        value = round(value - (since - datetime.fromisoformat(AT)) / timedelta(days=1))
    if isinstance(value, float):
        return float(f"{value:.{10 if place in PLACES else 5}g}")
    if isinstance(value, str):
        for secret, name in secrets.items():
            value = value.replace(secret, name)
        value = TIME.sub(lambda found: _fixed(found[0], since), value)
        value = RANDOM.sub("-4b1f6c3a9d02e875", value)
        return value if len(value) <= MAX_TEXT else value[:MAX_TEXT].rsplit("\n", 1)[0] + "\n..."
    return value


def _fixed(text: str, since: datetime) -> str:
    moment = datetime.fromisoformat(text)
    moment = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
    return AT if abs(moment - since) < timedelta(days=1) else text


class Recorder:
    """Calls operations, and keeps body and answer of each."""

    def __init__(self, client: TestClient, secrets: Mapping[str, str]) -> None:
        self.client, self.secrets, self.since = client, secrets, datetime.now(UTC)
        self.examples: dict[str, dict[str, Any]] = {}

    def call(self, name: str, request: str, status: int = 200, **options: Any) -> Any:
        """Call an operation by ``"method path"``, and record it unless it is recorded already."""
        method, path = request.split(" ")
        answer = self.client.request(method, path, **options)
        assert answer.status_code == status, (name, answer.status_code, answer.text)
        media_type = answer.headers.get("content-type", "").partition(";")[0]
        is_json = bool(answer.content) and media_type == "application/json"
        content = answer.json() if is_json else answer.text if media_type[:5] == "text/" else None
        if media_type == "text/plain":  # without what every process reports
            lines = content.splitlines()
            content = "\n".join(line for line in lines if "heliotwin" in line)
        example = self.examples.setdefault(name, {"answers": {}})
        if "json" in options:
            example.setdefault("body", self._short(options["json"]))
        if content is not None:
            example["answers"].setdefault(str(status), {media_type: self._short(content)})
        return content

    def _short(self, value: Any) -> Any:
        return shorten(value, self.secrets, self.since)

    def run(self, operation: str, path: str, /, **payload: Any) -> dict[str, Any]:
        """Begin a job, run it here, and return it."""
        job = self.call(operation, f"POST {path}", 202, json=payload)
        runtime = self.client.app.state.runtime  # type: ignore[attr-defined]
        assert Worker(runtime, KINDS, "example", threading.Event()).work()
        done: dict[str, Any] = self.client.get(f"/v1/jobs/{job['id']}").json()
        assert done["state"] == "done", done["reason"]
        return done


def times_of(suns: np.ndarray) -> list[datetime]:
    """When the sun was nearest to each of N suns (N, 3), in spring 2026, to a minute."""
    begin = datetime(2026, 3, 18, tzinfo=UTC)
    moments = [begin + timedelta(minutes=4 * step) for step in range(100 * 360)]
    seen = sun_direction(*sun_positions(moments, ORIGIN).T)
    return [moments[int(index)] for index in (suns @ seen.T).argmax(axis=1)]


def photographs(root: Path, name: str) -> list[tuple[Path, dict[str, Any]]]:
    """Camera frames of a heliostat with their metadata."""
    found = []
    for file in sorted((root / name / "Calibration").glob("*-raw.png")):
        about = json.loads(
            file.with_name(file.name.replace("raw.png", "calibration-properties.json")).read_text()
        )
        metadata = {
            "id": file.name.partition("-")[0],
            "kind": "raw",
            "target": about["target_name"],
            "sun": {
                "azimuth_deg": round(azimuth_from_north(about["sun_azimuth"]), 4),
                "elevation_deg": round(about["sun_elevation"], 4),
            },
            "motor_position": list(about["motor_position"].values()),
        }
        found.append((file, metadata))
    suns = np.array([list(one["sun"].values()) for _, one in found])
    for (_, metadata), moment in zip(found, times_of(sun_direction(*suns.T)), strict=True):
        metadata["taken_at"] = moment.isoformat().replace("+00:00", "Z")
    return found


def post_photograph(
    record: Recorder, name: str, file: Path, about: dict[str, Any], status: int
) -> None:
    record.call(
        "post_measurement",
        f"POST /v1/heliostats/{name}/measurements",
        status,
        files={"image": (file.name, file.read_bytes(), "image/png")},
        data={"metadata": json.dumps(about)},
    )
    record.examples["post_measurement"].setdefault("body", {"image": file.name, "metadata": about})


def set_up(record: Recorder, root: Path) -> None:
    """The plant, its targets and receivers, and its heliostats."""
    tower = json.loads((root / "demo-tower-measurements.json").read_text())
    record.call("put_plant", "PUT /v1/plant", json=tower | {"declared": {"cameras": [CAMERA]}})
    record.call("get_plant", "GET /v1/plant")
    record.call("list_targets", "GET /v1/targets")
    record.call("get_target", f"GET /v1/targets/{TARGET.name}")
    plane = {"center": [0, -3.2, 35.9], "normal": [0, 1, 0], "width": 8.6, "height": 7.2}
    cylinder = {"center": [0, 0, 55.2], "normal": [0, 1, 0], "radius": 4.1, "height": 5.2}
    cylinder["opening_deg"] = 60
    for what, body in (("target", {"plane": plane}), ("receiver", cylinder)):
        for status in (201, 200):
            record.call(f"put_{what}", f"PUT /v1/{what}s/upper-{what}", status, json=body)
    record.call("list_receivers", "GET /v1/receivers")
    record.call("get_receiver", "GET /v1/receivers/upper-receiver")
    for name in POSITIONS:
        file = root / name / "Properties" / f"{name}-heliostat-properties.json"
        properties = json.loads(file.read_text())
        body = {"name": name, "properties": properties}
        for status in (201, 200):
            record.call("post_heliostat", "POST /v1/heliostats", status, json=body)
    mirror = {
        "mount": {"kind": "azimuth_elevation", "pivot_height_m": 1.8},
        "facets": {"rows": 2, "columns": 2, "width_m": 1.6, "height_m": 1.25, "gap_m": 0.02},
        "facet_shape": "slant_range",
        "reflectance": 0.93,
        "slope_error_mrad": 1.2,
    }
    body = {"type": mirror, "east_m": 12.0, "north_m": 85.0, "up_m": 0.0}
    for status in (201, 200):
        record.call("put_heliostat", "PUT /v1/heliostats/AZ99", status, json=body)
    record.call("delete_heliostat", "DELETE /v1/heliostats/AZ99?reason=posted+by+mistake", 204)
    record.call("list_heliostats", "GET /v1/heliostats")
    record.call("get_heliostat", "GET /v1/heliostats/AB12")


def measure(record: Recorder, root: Path) -> None:
    """Photographs and their measurements."""
    undated = []
    for name in POSITIONS:
        for file, about in photographs(root, name):
            if name == "AK08":
                undated.append({"heliostat": name, "id": about["id"]})
                undated[-1]["taken_at"] = about.pop("taken_at")
            post_photograph(record, name, file, about, 201)
    post_photograph(record, name, file, about, 200)
    reason = "from the log of the cameras"
    record.call(
        "patch_times",
        "PATCH /v1/measurements/times",
        json={"reason": reason, "times": undated[:-1]},
    )
    path = "/v1/heliostats/AK08/measurements"
    one = f"{path}/{undated[0]['id']}"
    record.call(
        "patch_measurement",
        f"PATCH {one}",
        json={"reason": "from the weather station", "temperature_c": 21.5},
    )
    record.call("get_corrections", f"GET {one}/corrections")
    path = "/v1/heliostats/AB12/measurements"
    record.call("list_measurements", f"GET {path}")
    plant = "/v1/measurements?heliostat=AB12&until=2026-04-25T07:40:00Z"
    record.call("list_plant_measurements", f"GET {plant}")
    record.call("get_measurement", f"GET {path}/101")
    record.call("get_image", f"GET {path}/101/image")
    record.call("get_flux", f"GET {path}/101/flux")


def predict(record: Recorder, root: Path) -> None:
    """Surfaces, and decisions about them."""
    path = "/v1/heliostats/AB12/surfaces"
    for status in (201, 200):
        record.call("post_surface", f"POST {path}", status, json={"method": "network", "images": 4})
    file, about = photographs(root, "AF27")[0]
    about |= {"id": "199", "force": True, "reason": "the light of another heliostat"}
    post_photograph(record, "AB12", file, about, 201)
    wrong = record.call("post_surface", f"POST {path}", 201, json={"measurements": ["199"]})
    assert wrong["trusted"] is False, wrong["warnings"]
    choice = {"version": wrong["version"], "reason": "to acknowledge its warnings"}
    record.client.put(f"{path}/current", json=choice).raise_for_status()
    record.call("list_causes", "GET /v1/heliostats/AB12/causes")
    seen = {"reason": "photograph 199 is excluded"}
    record.call("acknowledge_surface", f"POST {path}/{wrong['version']}/acknowledge", json=seen)
    record.client.post(f"{path}/undo").raise_for_status()
    path = f"/v1/heliostats/AB12/measurements/{wrong['measurements'][0]}"
    record.call("delete_measurement", f"DELETE {path}", params={"reason": about["reason"]})
    path = "/v1/heliostats/AB12/surfaces"
    record.run("post_predictions_job", "/v1/jobs/predictions", images=4)
    record.run("post_imports_job", "/v1/jobs/imports", folder="plant")
    sent = {"file": ("plant.zip", zipped(root), "application/zip")}
    uploads = "/v1/jobs/imports/uploads"
    upload = record.call("post_import_upload", f"POST {uploads}", 201, files=sent)
    record.call("list_import_uploads", f"GET {uploads}")
    record.call("delete_import_upload", f"DELETE {uploads}/{upload['folder']}", 204)
    record.examples["post_import_upload"]["body"] = {"file": "plant.zip"}
    active = record.client.get(f"{path}/current").json()["version"]
    choice = {"version": 1 if active > 1 else 2, "reason": "measured before it was canted again"}
    record.call("put_current_surface", f"PUT {path}/current", json=choice)
    record.call("undo_decision", f"POST {path}/undo")
    record.call("list_decisions", f"GET {path}/decisions")
    record.call("list_surfaces", f"GET {path}")
    record.call("get_current_surface", f"GET {path}/current")
    record.call("get_surface", f"GET {path}/1")


def forecast(record: Recorder) -> None:
    """Forecasts of a heliostat and of the field."""
    sun = {"azimuth_deg": 200.0, "elevation_deg": 45.0}
    body = {"heliostat": "AB12", "target": TARGET.name, "sun": sun}
    made = record.call("post_forecast", "POST /v1/forecasts", 201, json=body)
    record.call("list_forecasts", "GET /v1/forecasts")
    record.call("get_forecast", f"GET /v1/forecasts/{made['id']}")
    field = {"target": "upper-receiver", "resolution": [64, 64]}
    job = record.run("post_forecasts_job", "/v1/jobs/forecasts", sun=sun, **field)
    record.call("get_job_flux", f"GET /v1/jobs/{job['id']}/flux")
    day = {"date": "2026-06-21", "first": "11:00", "last": "13:00", "step_minutes": 120}
    record.run("post_aim_plans_job", "/v1/jobs/aim-plans", day=day, limit_w_m2=40e3, **field)
    times = {"first_at": "2026-06-21T08:00:00Z", "last_at": "2026-06-21T16:00:00Z"}
    plan = record.run(
        "post_plans_job", "/v1/jobs/plans", name="a day in June", step_minutes=240, **times, **field
    )
    record.call("delete_job", f"DELETE /v1/jobs/{plan['id']}")


def point(record: Recorder) -> None:
    """Mounts, and where they point."""
    record.run("post_calibrations_job", "/v1/jobs/calibrations")
    path = "/v1/heliostats/AB12"
    record.call("list_mounts", f"GET {path}/mounts")
    record.call("get_current_mount", f"GET {path}/mounts/current")
    body = {"target": TARGET.name, "sun": {"at": "2026-06-21T11:30:00Z"}}
    record.call("post_motors", f"POST {path}/motors", json=body)
    plan = {"at": "2026-06-21T09:00:00Z", "photographs": 3}
    record.call("get_plan", "GET /v1/calibration-plan", params=plan)
    record.call("list_pointing", "GET /v1/pointing")
    record.call("get_pointing", f"GET {path}/pointing")
    record.call("list_field", "GET /v1/field")


def study(record: Recorder) -> None:
    """A study that finds the camera's curve."""
    options = {"surfaces": "measured", "candidates": ["camera_response", "slope_error"]}
    job = record.run("post_studies_job", "/v1/jobs/studies", **options)
    path = f"/v1/studies/{job['result']['study']}"
    record.call("list_studies", "GET /v1/studies")
    assert record.call("get_study", f"GET {path}")["verdict"] == "effect"
    record.call("get_study_report", f"GET {path}/report")
    record.call("get_study_change", f"GET {path}/change")
    reason = {"reason": "the camera's maker confirms the curve"}
    record.call("adopt_study", f"POST {path}/adopt", 201, json=reason)
    record.call("list_models", "GET /v1/models")
    record.call("get_current_model", "GET /v1/models/current")
    withdrawn = {"reason": "it was declared for another camera"}
    record.call("withdraw_study", f"POST {path}/withdraw", json=withdrawn)


def administrate(record: Recorder, key: str) -> None:
    """Jobs, alarms, the audit trail, sessions and probes."""
    job = record.run(
        "post_measurements_job", "/v1/jobs/measurements", reason="the lens was cleaned"
    )
    record.run("post_prunings_job", "/v1/jobs/prunings")
    path = f"/v1/jobs/{job['id']}"
    record.call("list_jobs", "GET /v1/jobs")
    record.call("get_job", f"GET {path}")
    record.call("get_job_events", f"GET {path}/events")
    last = {"Last-Event-ID": "9999999999"}
    record.call("get_job_events", f"GET {path}/events", 204, headers=last)
    choice = record.call("post_camera_choices_job", "POST /v1/jobs/camera-choices", 202, json={})
    record.client.post(f"/v1/jobs/{choice['id']}/cancel")  # the plant declares its camera
    waiting = record.call("post_predictions_job", "POST /v1/jobs/predictions", 202, json={})
    record.call("cancel_job", f"POST /v1/jobs/{waiting['id']}/cancel")
    writer = FieldStateWriter(record.client.app.state.runtime)  # type: ignore[attr-defined]
    while writer.update():
        pass
    alarms = record.call("list_alarms", "GET /v1/alarms")["items"]
    ids = {"ids": [alarms[0]["id"]], "reason": "the camera is being repaired"}
    record.call("post_acknowledgements", "POST /v1/alarms/acknowledgements", json=ids)
    path = "/v1/alarms/acknowledgements"
    batches = record.call("list_acknowledgements", f"GET {path}")["items"]
    record.call("list_alarm_causes", "GET /v1/alarms/causes")
    record.call("list_alarm_history", "GET /v1/alarms/history")
    record.call("undo_acknowledgements", f"POST {path}/{batches[0]['id']}/undo")
    record.call("delete_target", "DELETE /v1/targets/upper-target?reason=posted+by+mistake", 204)
    record.call(
        "delete_receiver", "DELETE /v1/receivers/upper-receiver?reason=posted+by+mistake", 204
    )
    record.call("list_audit", "GET /v1/audit")
    record.call("post_session", "POST /session", 204, data={"key": key})
    record.examples["post_session"]["body"] = {"key": KEY}
    record.call("delete_session", "DELETE /session", 204)
    record.call("get_livez", "GET /livez")
    record.call("get_readyz", "GET /readyz")
    record.call("get_metrics", "GET /metrics")


def record_all(folder: Path) -> dict[str, dict[str, Any]]:
    """Run the service on the demonstration's plant in ``folder``, and record all operations."""
    root = folder / "import" / "plant"
    write_plant(root, images=IMAGES, rays=RAYS)
    settings = Settings(data_dir=folder / "data", import_root=folder / "import", job_workers=0)
    app = create_app(settings)
    with TestClient(app, base_url="http://127.0.0.1") as client:
        with app.state.runtime.database.writing() as session:
            key = keys.create(session, "calibration", "admin", "example")
        client.headers["Authorization"] = f"Bearer {key}"
        record = Recorder(client, {key: KEY, str(folder): "/var/lib/heliotwin"})
        set_up(record, root)
        measure(record, root)
        predict(record, root)
        forecast(record)
        point(record)
        study(record)
        administrate(record, key)
    return dict(sorted(record.examples.items()))


def main() -> None:
    kind._REPORT_EVERY_S = 0  # the last report of a job does not depend on the time
    with tempfile.TemporaryDirectory() as folder:
        examples = record_all(Path(folder))
    lines = [f"{json.dumps(name)}: {json.dumps(one)}" for name, one in examples.items()]
    FILE.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")


if __name__ == "__main__":
    main()
