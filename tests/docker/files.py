"""The files of the container: where they lie, and what they say."""

import json
from pathlib import Path

ROOT = Path(__file__).parents[2]
DOCKER = ROOT / "docker"
SECRET = "/run/secrets/database_password"


def drawn_expressions() -> list[str]:
    """What the dashboard asks Prometheus for."""
    panels = json.loads((DOCKER / "grafana" / "heliotwin.json").read_text(encoding="utf-8"))[
        "panels"
    ]
    return [target["expr"] for panel in panels for target in panel["targets"]]
