"""Pictures of a running service's pages at a desk and on a phone: ``python -m tests.benchmarks.pages [--url URL]``.

They are there to be looked at: ``results/pages`` has those of the demonstration's store. Needs Chromium and
playwright.
"""

import argparse
import shutil
from pathlib import Path

from playwright.sync_api import sync_playwright

SIZES = {"desk": {"width": 1440, "height": 900}, "phone": {"width": 390, "height": 844}}


def main() -> None:
    """Take them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--url", default="http://127.0.0.1:8000")
    parser.add_argument("--heliostat", default="AA39")
    parser.add_argument("--photograph", default="1", help="an identifier of the heliostat's")
    parser.add_argument("--out", type=Path, default=Path("results/pages"))
    options = parser.parse_args()
    heliostat = f"/heliostats/{options.heliostat}"
    pages = {
        "field": "/",
        "heliostat": heliostat,
        "photograph": f"{heliostat}/photographs/{options.photograph}",
        "compare": f"/compare?heliostat={options.heliostat}",
        "attention": "/attention",
        "plans": "/plans",
    }
    options.out.mkdir(parents=True, exist_ok=True)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        for label, size in SIZES.items():
            page = browser.new_page(viewport=size)
            for name, path in pages.items():
                answer = page.goto(options.url + path, wait_until="networkidle")
                assert answer is not None
                page.screenshot(path=options.out / f"{name}-{label}.jpg", full_page=True, type="jpeg", quality=60)
                width = page.evaluate("document.documentElement.scrollWidth")
                print(f"{name}, {label}: {answer.status}, {width} px wide", flush=True)
        browser.close()


if __name__ == "__main__":
    main()
