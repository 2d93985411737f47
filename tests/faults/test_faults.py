"""Every fault on both databases; ``python -m benchmarks.faults`` prints what
comes of them.
"""

from pathlib import Path

import psycopg
import pytest

from .harness import new_store
from .scenarios import SCENARIOS, NotTriedError


@pytest.mark.parametrize("engine", ["sqlite", pytest.param("postgres", marks=pytest.mark.postgres)])
@pytest.mark.parametrize("name", SCENARIOS)
def test_nothing_acknowledged_is_lost(name: str, engine: str, tmp_path: Path):
    try:
        with new_store(engine, tmp_path) as store:
            print(SCENARIOS[name](store))
    except NotTriedError as reason:
        pytest.skip(str(reason))
    except psycopg.OperationalError as error:
        pytest.skip(f"no PostgreSQL server: {error}")
