"""A calibration system's side of heliotwin, as an example to start from: Python 3.11, nothing else.

    python example_client.py --url http://127.0.0.1:8000 --key-file ingest.key SPOOL [--predict]

SPOOL/HELIOSTAT/NAME.png, .jpg or .jpeg with its metadata in NAME.json beside it is sent, and moved
to SPOOL/sent when the service has acknowledged it; what the service cannot take is moved to
SPOOL/rejected with the reason in NAME.reason. An image that is not written to its end yet, or whose
metadata are not, is left for the next time; so is all where the key is wrong or no heliotwin
answers, which ends it. Ended at any moment and started again, it loses nothing; what it sends twice
is stored once, for the same image again is the same measurement. With --predict (a key of role
operate) each heliostat that got a photograph gets a new surface, and a forecast.
"""

import argparse
import http.client
import json
import sys
import time
import urllib.error
import urllib.parse
import urllib.request
import uuid
from pathlib import Path
from typing import Any

# Answers after which the same request may succeed later.
AGAIN = (408, 429, 500, 502, 503, 504, 507)
# Errors of this request. Any other, 401 for example, is an error of the sender and applies to
# every request.
ABOUT_THIS = (404, 409, 413, 415, 422)
LONGEST_PAUSE_S = 60.0


# How files end that are written to their end.
ENDS = {".png": b"IEND\xaeB`\x82", ".jpg": b"\xff\xd9", ".jpeg": b"\xff\xd9"}


class RejectedError(Exception):
    """The service understood the request and does not take it; trying again would find the same."""


class StoppedError(Exception):
    """Nothing goes until somebody acts: the key is wrong, or this is no heliotwin."""


class Heliotwin:
    """The calls; each is tried until the service answers, with growing pauses."""

    def __init__(self, url: str, key: str = "", timeout_s: float = 3600.0) -> None:
        self.url = url.rstrip("/")
        self.key = key
        self.timeout_s = timeout_s

    def send_photograph(
        self, heliostat: str, image: bytes, metadata: dict[str, Any]
    ) -> dict[str, Any]:
        """The measurement that the photograph became; it is stored for good when this returns."""
        boundary = uuid.uuid4().hex
        parts = (
            ('name="metadata"', b"application/json", json.dumps(metadata).encode()),
            ('name="image"; filename="spot"', b"application/octet-stream", image),
        )
        body = b"".join(
            b"--%b\r\nContent-Disposition: form-data; %b\r\nContent-Type: %b\r\n\r\n%b\r\n"
            % (boundary.encode(), name.encode(), kind, content)
            for name, kind, content in parts
        )
        body += b"--%b--\r\n" % boundary.encode()
        path = f"/v1/heliostats/{urllib.parse.quote(heliostat, safe='')}/measurements"
        return self.call("POST", path, body, f"multipart/form-data; boundary={boundary}")

    def predict(self, heliostat: str) -> dict[str, Any]:
        """A new version of the heliostat's surface from its newest photographs."""
        return self.post(
            f"/v1/heliostats/{urllib.parse.quote(heliostat, safe='')}/surfaces",
            {"method": "network"},
        )

    def forecast(
        self, heliostat: str, target: str, azimuth_deg: float, elevation_deg: float
    ) -> dict[str, Any]:
        """The flux of the current surface on a target, its peak [W/m2] and power [W]
        among others.
        """
        sun = {"azimuth_deg": azimuth_deg, "elevation_deg": elevation_deg}
        return self.post("/v1/forecasts", {"heliostat": heliostat, "target": target, "sun": sun})

    def post(self, path: str, document: dict[str, Any]) -> dict[str, Any]:
        """Send a JSON document."""
        return self.call("POST", path, json.dumps(document).encode(), "application/json")

    def get(self, path: str) -> dict[str, Any]:
        """Read a resource."""
        return self.call("GET", path)

    def call(
        self, method: str, path: str, body: bytes | None = None, kind: str = ""
    ) -> dict[str, Any]:
        """One request until it is answered; `RejectedError` where that is no, `StoppedError` where
        it stays so.
        """
        until, pause_s = time.monotonic() + self.timeout_s, 0.5
        while True:
            try:
                return self._ask(method, path, body, kind)
            except urllib.error.HTTPError as error:
                reason, is_ours = _reason(error)
                if error.code in ABOUT_THIS and is_ours:
                    raise RejectedError(reason) from error
                if error.code not in AGAIN:
                    raise StoppedError(f"{self.url}: {reason}") from error
                wait_s = max(pause_s, _retry_after_s(error))
            except ValueError as error:  # no address, or an answer that is no JSON
                raise StoppedError(f"{self.url}: this is no heliotwin ({error})") from error
            except (OSError, http.client.HTTPException) as error:
                # No connection, or it broke: whether the request arrived is unknown.
                reason, wait_s = str(error), pause_s
            if time.monotonic() + wait_s > until:
                raise TimeoutError(f"{method} {path}: {reason}")
            print(f"waiting {wait_s:.0f} s: {reason}", file=sys.stderr)
            time.sleep(wait_s)
            pause_s = min(2 * pause_s, LONGEST_PAUSE_S)

    def _ask(self, method: str, path: str, body: bytes | None, kind: str) -> dict[str, Any]:
        headers = {"Accept": "application/json"}
        if self.key:
            headers["Authorization"] = f"Bearer {self.key}"
        if kind:
            headers["Content-Type"] = kind
        request = urllib.request.Request(self.url + path, body, headers, method=method)
        with urllib.request.urlopen(request, timeout=120) as answer:
            content = answer.read()
        document: dict[str, Any] = json.loads(content)
        return document


def _retry_after_s(error: urllib.error.HTTPError) -> float:
    """How long to wait at least [s]; a proxy may name a date instead, which is left out."""
    delay = error.headers.get("Retry-After") or ""
    return float(delay) if delay.isdecimal() else 0.0


def _reason(error: urllib.error.HTTPError) -> tuple[str, bool]:
    """What a problem document says, with the id that the service's log knows the request by; and
    whether it is one.
    """
    try:
        document = json.load(error)
        return f"{error.code}: {document['detail']} (request {document['request_id']})", True
    except (ValueError, KeyError, TypeError):  # a proxy's answer
        return f"{error.code} {error.reason}", False


def _move(image: Path, spool: Path, to: str) -> Path:
    folder = spool / to / image.parent.name
    folder.mkdir(parents=True, exist_ok=True)
    for file in (image, image.with_suffix(".json")):
        file.rename(folder / file.name)
    return folder / image.name


def _whole(image: Path) -> tuple[bytes, dict[str, Any]] | None:
    """A photograph and its metadata; None while one of them is being written."""
    try:
        content = image.read_bytes()
        metadata = json.loads(image.with_suffix(".json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return (content, metadata) if ENDS[image.suffix.lower()] in content[-64:] else None


def send_all(service: Heliotwin, spool: Path) -> dict[str, str]:
    """Send what lies in the spool, oldest first; the heliostats that got an accepted photograph,
    with its target.

    Files that are neither photographs nor their metadata are named, and stay.
    """
    touched = {}
    folders = [
        folder
        for folder in spool.iterdir()
        if folder.is_dir() and folder.name not in ("sent", "rejected")
    ]
    files = [path for folder in folders for path in folder.iterdir()]
    images = [path for path in files if path.suffix.lower() in ENDS]
    for path in (path for path in files if path.suffix.lower() not in (*ENDS, ".json")):
        print(
            f"{path.parent.name}/{path.name}: left, it is neither {', '.join(ENDS)} nor .json",
            file=sys.stderr,
        )
    for image in sorted(images, key=lambda path: path.stat().st_mtime):
        heliostat, read = image.parent.name, _whole(image)
        if read is None:
            print(
                f"{heliostat}/{image.stem}: left for the next time, it or its metadata are not"
                " whole"
            )
            continue
        content, metadata = read
        try:
            measured = service.send_photograph(heliostat, content, metadata)
        except RejectedError as refusal:
            _move(image, spool, "rejected").with_suffix(".reason").write_text(
                f"{refusal}\n", encoding="utf-8"
            )
            print(f"{heliostat}/{image.stem}: rejected, {refusal}")
            continue
        _move(image, spool, "sent")
        if measured["accepted"]:
            touched[heliostat] = metadata["target"]
        print(
            f"{heliostat}/{measured['id']}:"
            f" {'accepted' if measured['accepted'] else 'refused, ' + measured['reason']}"
        )
    return touched


def forecast_all(service: Heliotwin, touched: dict[str, str]) -> bool:
    """A new surface and a forecast on its target of each heliostat; whether all of them
    came about.
    """
    is_whole = True
    for heliostat, target in touched.items():
        try:
            surface = service.predict(heliostat)
            forecast = service.forecast(heliostat, target, azimuth_deg=180.0, elevation_deg=45.0)
        except RejectedError as refusal:
            print(f"{heliostat}: no forecast, {refusal}", file=sys.stderr)
            is_whole = False
            continue
        print(
            f"{heliostat}: surface {surface['version']}, forecast peak {forecast['peak_w_m2']:.0f}"
            " W/m2"
        )
    return is_whole


def main(arguments: list[str] | None = None) -> None:
    """Send the spool once."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("spool", type=Path)
    parser.add_argument("--url", default="http://127.0.0.1:8000")
    parser.add_argument("--key-file", type=Path, help="file with the API key")
    parser.add_argument(
        "--patience", type=float, default=3600.0, help="how long to try a request [s]"
    )
    parser.add_argument("--predict", action="store_true")
    options = parser.parse_args(arguments)
    if options.key_file and not options.key_file.is_file():
        parser.error(
            f"there is no file {options.key_file}; write the key into it, or name another one"
        )
    key = options.key_file.read_text(encoding="utf-8").strip() if options.key_file else ""
    service = Heliotwin(options.url, key, options.patience)
    if not options.spool.is_dir():
        parser.error(
            f"there is no folder {options.spool}; make it, with a folder for each heliostat in it"
        )
    try:
        touched = send_all(service, options.spool)
        is_whole = forecast_all(service, touched) if options.predict else True
    except (StoppedError, TimeoutError) as error:
        print(f"stopped, the rest is left for the next time: {error}", file=sys.stderr)
        sys.exit(1)
    if not is_whole:
        sys.exit(1)


if __name__ == "__main__":
    main()
