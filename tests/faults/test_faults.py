"""Every fault on both databases; ``python -m benchmarks.faults`` prints what
comes of them.
"""

from pathlib import Path

import psycopg
import pytest

from service.twin.runtime import Runtime
from tests.service.conftest import FakeOperations
from tests.service.exported import require_round_trip

from .harness import new_store
from .scenarios import SCENARIOS, NotTriedError


@pytest.mark.parametrize("engine", ["sqlite", pytest.param("postgres", marks=pytest.mark.postgres)])
@pytest.mark.parametrize("name", SCENARIOS)
def test_nothing_acknowledged_is_lost(name: str, engine: str, tmp_path: Path):
    try:
        with new_store(engine, tmp_path) as store:
            print(SCENARIOS[name](store))
            if name != "full_disk":  # its disk is gone
                runtime = Runtime.from_settings(store.settings, FakeOperations())
                try:
                    require_round_trip(runtime, FakeOperations(), tmp_path / "export")
                finally:
                    runtime.close()
    except NotTriedError as reason:
        pytest.skip(str(reason))
    except psycopg.OperationalError as error:
        pytest.skip(f"no PostgreSQL server: {error}")
