"""Settings: safe by default, unsafe ones refused, passwords in files."""

from pathlib import Path

import pytest
from pydantic import ValidationError

from service.base.settings import Settings, is_loopback, is_within


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # where no .env lies


def test_defaults_need_nothing():
    settings = Settings()
    assert settings.database.drivername == "sqlite"
    assert settings.database.database == "heliotwin-data/heliotwin.sqlite"
    assert settings.migrates_on_start
    assert settings.host == "127.0.0.1"


def test_environment_is_read(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("HELIOTWIN_DATABASE_URL", "postgresql://helio@db/twin")
    monkeypatch.setenv("HELIOTWIN_PORT", "9000")
    settings = Settings()
    assert settings.database.drivername == "postgresql+psycopg"
    assert settings.port == 9000
    assert not settings.migrates_on_start


def test_password_comes_from_its_file(tmp_path: Path):
    secret = tmp_path / "password"
    secret.write_text("s3:cr/et@\n")
    settings = Settings(database_url="postgresql://helio@db/twin", database_password_file=secret)
    assert settings.database.password == "s3:cr/et@"
    assert "s3" not in repr(settings)
    assert "s3" not in str(settings.database)


@pytest.mark.parametrize("host", ["127.0.0.1", "127.9.9.9", "::1", "localhost"])
def test_loopback_is_known(host: str):
    assert is_loopback(host)


@pytest.mark.parametrize(
    "host", ["0.0.0.0", "::", "192.168.1.5", "plant.example", "127.0.0.1.example", ""]
)
def test_anything_else_may_be_reached_by_others(host: str):
    assert not is_loopback(host)


@pytest.mark.parametrize("url", ["mysql://a/b", "nonsense", "", "postgresql"])
def test_other_databases_are_refused(url: str):
    with pytest.raises(ValidationError, match="database_url"):
        Settings(database_url=url)


def test_workers_have_connections_of_their_own():
    """64 workers with their heartbeats shared 69 connections with 40 threads of requests."""
    for workers in (0, 1, 64):
        assert Settings(job_workers=workers).connections >= 40 + 2 * (workers + (workers > 0))
    assert Settings(job_workers=64, database_connections=138).connections == 138
    with pytest.raises(
        ValidationError,
        match="too few for job_workers 64 and those for short jobs; set at least 138",
    ):
        Settings(job_workers=64, database_connections=100)


@pytest.mark.parametrize(
    "proxies", ["*", "proxy.example", "10.0.0.1/8", "127.0.0.1,", "10.0.0.0/33"]
)
def test_proxies_are_named_by_addresses(proxies: str):
    with pytest.raises(ValidationError, match="forwarded_allow_ips"):
        Settings(forwarded_allow_ips=proxies)


def test_proxies_are_believed_where_they_are_named():
    settings = Settings(forwarded_allow_ips="10.1.0.0/16, ::1")
    assert is_within("10.1.2.3", settings.trusted_proxies)
    assert is_within("::1", settings.trusted_proxies)
    assert not any(
        is_within(host, settings.trusted_proxies)
        for host in ("10.2.0.1", "127.0.0.1", "", "localhost")
    )
    assert Settings(proxy_headers=False).trusted_proxies == ()


def test_map_scales_are_named_and_run_from_fine_to_poor():
    made = Settings(map_scales={"accuracy": (98, 90)})
    assert (made.map_scales["accuracy"], made.map_scales["age_days"]) == ((98, 90), (0, 365))
    for wrong in (
        {"accuracy": (80, 95)},
        {"age_days": (10, 10)},
        {"age_days": (30, 10)},
        {"beauty": (0, 1)},
    ):
        with pytest.raises(ValidationError, match="map_scales"):
            Settings(map_scales=wrong)


def test_zone_is_one_of_the_tz_database():
    assert Settings(time_zone="Europe/Berlin").time_zone == "Europe/Berlin"
    for wrong in ("Juelich", "../etc/passwd", ""):
        with pytest.raises(ValidationError, match="tz database"):
            Settings(time_zone=wrong)
