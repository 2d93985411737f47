"""Pictures of a running service's pages at a desk and on a phone: ``python -m
tests.benchmarks.pages [--url URL]``.

They are there to be looked at: ``results/pages`` has those of the demonstration's store, for which
a plan, a forecast, mounts and a study are asked for first. Needs Chromium and playwright.
"""

import argparse
import shutil
import time
from pathlib import Path
from typing import Any, Literal

import httpx
from playwright.sync_api import ViewportSize, sync_playwright

SIZES: dict[str, ViewportSize] = {
    "desk": {"width": 1440, "height": 900},
    "phone": {"width": 390, "height": 844},
}


SCHEMES: dict[str, Literal["light", "dark"]] = {"": "light", "-dark": "dark"}
"""Dark ones are taken of a few pages at a desk."""

DARK = ("field", "heliostat", "plan")

HIGHEST = 3200
"""What of a long page is taken [px]."""


def done(client: httpx.Client, kind: str, asked: dict[str, Any]) -> dict[str, Any]:
    """A job that is asked for, once it has ended."""
    job: dict[str, Any] = client.post(f"/v1/jobs/{kind}", json=asked).raise_for_status().json()
    while job["state"] in ("queued", "running"):
        time.sleep(1)
        job = client.get(f"/v1/jobs/{job['id']}").raise_for_status().json()
    print(f"{kind}: {job['state']} {job.get('reason') or ''}", flush=True)
    return job


def asked_for(client: httpx.Client, heliostat: str) -> dict[str, str]:
    """Pages of a plan, a forecast and a study that are made for the pictures, by name; mounts are
    calibrated, too.
    """
    target = client.get("/v1/targets").raise_for_status().json()["items"][0]["name"]
    day = {
        "first_at": "2026-06-21T06:00:00Z",
        "last_at": "2026-06-21T16:00:00Z",
        "step_minutes": 60,
    }
    plan = done(client, "plans", {"name": "June", "target": target, "allowed_w_m2": 8000.0, **day})
    sun = {"azimuth_deg": 200.0, "elevation_deg": 45.0}
    forecast = client.post(
        "/v1/forecasts", json={"heliostat": heliostat, "target": target, "sun": sun}
    )
    done(client, "calibrations", {})
    study = done(client, "studies", {})
    paths = {
        "plan": f"/plans/{plan['id']}",
        "forecast": f"/forecasts/{forecast.raise_for_status().json()['id']}",
    }
    found = client.get("/v1/studies").raise_for_status().json()["items"]
    return (
        paths
        | {"job": f"/jobs/{study['id']}"}
        | ({"study": f"/studies/{found[0]['id']}"} if found else {})
    )


def main() -> None:
    """Take them."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--url", default="http://127.0.0.1:8000")
    parser.add_argument("--heliostat", default="AA39")
    parser.add_argument("--photograph", default="1", help="an identifier of the heliostat's")
    parser.add_argument("--out", type=Path, default=Path("results/pages"))
    options = parser.parse_args()
    heliostat = f"/heliostats/{options.heliostat}"
    pages = {
        "field": "/",
        "heliostat": heliostat,
        "photographs": "/photographs",
        "photograph": f"{heliostat}/photographs/{options.photograph}",
        "compare": f"/compare?heliostat={options.heliostat}",
        "attention": "/attention",
        "calibration-plan": "/calibration-plan?at=2026-06-21T10:00",
        "jobs": "/jobs",
        "studies": "/studies",
        "plant": "/plant",
        "settings": "/plant/settings",
        "keys": "/plant/keys",
        "audit": "/plant/audit",
        "login": "/login",
    }
    with httpx.Client(base_url=options.url, timeout=120) as client:
        pages |= asked_for(client, options.heliostat)
        while "being computed" in client.get("/", headers={"Accept": "text/html"}).text:
            time.sleep(1)
    options.out.mkdir(parents=True, exist_ok=True)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=shutil.which("chromium"), args=["--no-sandbox"]
        )
        for label, size in SIZES.items():
            for suffix, scheme in SCHEMES.items():
                page = browser.new_page(viewport=size, color_scheme=scheme, bypass_csp=True)
                for name in pages if not suffix else DARK if label == "desk" else ():
                    answer = page.goto(options.url + pages[name], wait_until="networkidle")
                    assert answer is not None
                    # Small pictures are loaded where they come into sight.
                    page.evaluate("for (const one of document.images) one.loading = 'eager'")
                    page.wait_for_function("[...document.images].every(one => one.complete)")
                    file = options.out / f"{name}-{label}{suffix}.jpg"
                    height = min(page.evaluate("document.documentElement.scrollHeight"), HIGHEST)
                    clip = {"x": 0, "y": 0, "width": size["width"], "height": height}
                    page.screenshot(path=file, full_page=True, clip=clip, type="jpeg", quality=30)
                    width = page.evaluate("document.documentElement.scrollWidth")
                    print(f"{name}, {label}{suffix}: {answer.status}, {width} px wide", flush=True)
                page.close()
        browser.close()


if __name__ == "__main__":
    main()
