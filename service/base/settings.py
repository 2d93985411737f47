"""Settings of the service, from the environment (prefix ``HELIOTWIN_``) or a ``.env`` file."""

import ipaddress
import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Self
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

from pydantic import Field, SecretStr, field_validator, model_validator
from pydantic_settings import BaseSettings, SettingsConfigDict
from sqlalchemy import URL, make_url
from sqlalchemy.exc import ArgumentError

Network = ipaddress.IPv4Network | ipaddress.IPv6Network

LogLevel = Literal["critical", "error", "warning", "info", "debug"]

_DRIVERS = {"sqlite": "sqlite", "postgresql": "postgresql+psycopg"}

WEB_CONNECTIONS = 48
"""Database connections of a process without workers: one for each of the 40 threads that routes run in, and some for
those that ask for keys, follow jobs and check readiness."""

WORKER_CONNECTIONS = 2
"""Those of a worker: for its work and for its heartbeat."""

_LEAST_WEB_CONNECTIONS = 8

MAP_SCALES: dict[str, tuple[float, float]] = {
    "accuracy": (95.0, 75.0),
    "deviation": (0.0, 2.0),
    "uncertainty": (0.0, 0.5),
    "misfit": (5.0, 30.0),
    "age": (0.0, 365.0),
    "pointing": (0.0, 3.0),
    "sun_span": (60.0, 0.0),
}
"""What is fine and what is poor of the figures that the field's map shows, unless the settings say otherwise."""

FIGURE_SCALES: dict[str, float] = {
    "heights": 2.0,
    "height_change": 1.0,
    "height_std": 0.5,
    "flux_difference": 0.3,
    "mean_difference": 0.1,
}
"""Where the colours of maps end, on both sides of zero, unless the settings say otherwise: heights of a mirror, their
change and their standard deviation [mm]; forecast minus photograph, of one and in the mean [of the measured peak].
"""


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach a server that listens on ``host``."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False  # a name that may resolve anywhere


def networks_of(text: str) -> tuple[Network, ...]:
    """Addresses and networks with commas between; ValueError for anything else, and for `*`, which trusts everybody."""
    return tuple(ipaddress.ip_network(part.strip()) for part in text.split(","))


def is_within(host: str, networks: Iterable[Network]) -> bool:
    """Whether an address lies in one of these networks; nothing else than an address does."""
    try:
        address = ipaddress.ip_address(host)
    except ValueError:
        return False
    return any(address in network for network in networks)


@dataclass(frozen=True)
class Shown:
    """A setting in force, as people may see it; ``is_set`` where it does not come from the defaults."""

    name: str
    value: str
    is_set: bool
    about: str


def _harmless(value: Any) -> str:
    """A value as text; of a URL neither password nor query, which may hold secrets."""
    if isinstance(value, str) and "://" in value:
        url = make_url(value)
        shown = url.set(query={}).render_as_string(hide_password=True)
        return f"{shown}?***" if url.query else shown
    if isinstance(value, dict):
        return ", ".join(f"{name} {_harmless(inner)}" for name, inner in value.items())
    if isinstance(value, tuple):
        return " to ".join(map(_harmless, value))
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.15g}" if isinstance(value, float) else str(value)


class Settings(BaseSettings):
    """What an operator may set; unsafe combinations are refused when the settings are read."""

    model_config = SettingsConfigDict(
        env_prefix="HELIOTWIN_", env_file=".env", extra="ignore", frozen=True, env_ignore_empty=True
    )

    data_dir: Path = Field(
        default=Path("heliotwin-data"), description="Folder of the images and of the embedded database."
    )
    database_url: str | None = Field(
        default=None, description="sqlite:///FILE or postgresql://USER@HOST/NAME; without it SQLite inside data_dir."
    )
    database_password_file: Path | None = Field(
        default=None, description="File holding the database password, so that no URL or environment does."
    )
    database_connections: int | None = Field(
        default=None,
        ge=1,
        le=1000,
        description="Most connections of this process, at least 8 and 2 for each of its job_workers; without it 48 and "
        "2 for each. PostgreSQL's max_connections must hold those of all processes.",
    )
    migrate_on_start: bool | None = Field(
        default=None, description="Bring the schema to its newest version at start; without it only SQLite is migrated."
    )
    host: str = Field(default="127.0.0.1", description="Address to listen on.")
    port: int = Field(default=8000, ge=1, le=65535, description="Port to listen on.")
    allow_open_network: bool = Field(
        default=False,
        description="Unsafe: while no key was made, whoever reaches a non-loopback host may read and write everything.",
    )
    proxy_headers: bool = Field(
        default=True, description="Believe X-Forwarded-For and X-Forwarded-Proto of the proxies in forwarded_allow_ips."
    )
    forwarded_allow_ips: str = Field(
        default="127.0.0.1,::1",
        description="Addresses and networks of trusted proxies, with commas between; never one that clients come from.",
    )
    max_image_bytes: int = Field(default=32 * 2**20, ge=1024, description="Largest image accepted [bytes].")
    max_image_pixels: int = Field(
        default=50_000_000, ge=1024, description="Largest image accepted, width x height [pixels]."
    )
    max_json_bytes: int = Field(
        default=2**20, ge=1024, description="Largest request body that is not an image [bytes]."
    )
    requests_per_s: float = Field(
        default=200.0,
        gt=0,
        le=1e6,
        description="Requests of one key, or one client without a key, each second; 64 KiB of answers count as one.",
    )
    requests_burst: int = Field(default=400, ge=1, le=10**6, description="Most of them at once after a pause.")
    most_connections: int = Field(
        default=1000, ge=10, le=100_000, description="Open connections beyond which requests are answered 503."
    )
    most_watchers: int = Field(
        default=200, ge=1, le=10_000, description="Jobs that are followed at a time (event streams); 503 beyond."
    )
    most_watchers_of_key: int = Field(
        default=50, ge=1, le=10_000, description="Those of one key, or of all without a key; 429 beyond."
    )
    most_connections_each: int = Field(
        default=100,
        ge=1,
        le=100_000,
        description="Those of one address, of a /64 with IPv6; this machine and trusted proxies have no such bound.",
    )
    least_bytes_per_s: float = Field(
        default=4096.0, gt=0, le=1e9, description="Bytes of a body that must come each second, on the whole [bytes/s]."
    )
    parallel_computations: int = Field(
        default=2, ge=1, le=64, description="Measurements, predictions and tracings at a time."
    )
    ray_address: str | None = Field(
        default=None,
        min_length=1,
        description="HOST:PORT of a Ray cluster that works at fleet forecasts, `local` for one of this machine's; "
        "without it threads do.",
    )
    job_workers: int = Field(
        default=1, ge=0, le=64, description="Jobs that `serve` works at itself at a time; 0 where `worker` does."
    )
    job_lease_s: float = Field(
        default=30.0, ge=0.5, le=3600, description="A worker that was silent for so long [s] has lost its job."
    )
    job_silence_s: float = Field(
        default=3600.0,
        ge=0.5,
        le=604_800,
        description="A job that told nothing of itself for so long [s] hangs: its worker gives it up, and ends.",
    )
    job_poll_s: float = Field(default=0.5, ge=0.05, le=60, description="How often workers look for jobs [s].")
    job_attempts: int = Field(default=3, ge=1, le=20, description="How often a job is tried before it has failed.")
    job_retry_s: float = Field(
        default=5.0, ge=0, le=600, description="Pause before the second attempt [s]; it doubles from then on."
    )
    max_queued_jobs: int = Field(default=1000, ge=1, description="Most jobs that may wait.")
    import_root: Path | None = Field(
        default=None, description="Folder whose subfolders jobs may import; without it no job imports."
    )
    job_retention_days: float = Field(
        default=90.0,
        ge=0,
        le=36500,
        description="Jobs that ended so long ago [days] are deleted, but for plans that are done; 0 keeps all.",
    )
    forecast_retention_days: float = Field(
        default=365.0, ge=0, le=36500, description="Forecasts made so long ago [days] are deleted; 0 keeps all."
    )
    refused_image_retention_days: float = Field(
        default=90.0, ge=0, le=36500, description="Refused photographs so old [days] lose their image; 0 keeps all."
    )
    image_retention_days: float = Field(
        default=730.0,
        ge=0,
        le=36500,
        description="Accepted photographs so old [days] lose their image, unless today's surface was made from them; 0 "
        "keeps all.",
    )
    image_quota_gb: float = Field(
        default=2000.0,
        ge=0,
        le=1e6,
        description="Most that images may take [GB]; beyond it the oldest go, refused ones first, but never what "
        "today's surfaces were made from. 0 sets no bound.",
    )
    audit_retention_days: float = Field(
        default=1825.0, ge=0, le=36500, description="Audit entries so old [days] are deleted; 0 keeps all."
    )
    log_level: LogLevel = Field(default="info", description="The least that is logged.")
    log_format: Literal["text", "json"] = Field(default="text", description="json: one object a line.")
    time_zone: str | None = Field(
        default=None, description="The plant's zone, as `Europe/Berlin`: pages tell times in it beside UTC."
    )
    map_scales: dict[str, tuple[float, float]] = Field(
        default_factory=dict,
        validate_default=True,
        description="JSON: what is fine and what is poor, which is where the map's colours begin and end, of accuracy "
        "[%], deviation, uncertainty [mm], misfit [%], age [days], pointing [mrad] and sun_span [deg], such as "
        '{"accuracy": [95, 80]}.',
    )
    figure_scales: dict[str, float] = Field(
        default_factory=dict,
        validate_default=True,
        description="JSON: where the colours of maps end, on all pages alike, of heights, height_change and height_std "
        "[mm], flux_difference and mean_difference [share of the measured peak], such as "
        '{"heights": 3}; what lies beyond has the end colours, and is said.',
    )
    attention_accuracy: float = Field(
        default=0.75, ge=0, le=1, description="Forecast accuracy below which a heliostat needs attention [1]."
    )
    attention_accuracy_drop: float = Field(
        default=0.05,
        ge=0,
        le=1,
        description="By how much more than this the accuracy of a heliostat's newest photographs must have fallen [1], "
        "surely (95 %), for it to need attention.",
    )
    attention_pointing_mrad: float = Field(
        default=3.0, gt=0, le=1000, description="Pointing error above which it does [mrad]."
    )
    attention_moved_days: float = Field(
        default=90.0, ge=0, le=36500, description="For so long after it moved it does [days]."
    )
    attention_photograph_days: float = Field(
        default=30.0, gt=0, le=36500, description="So long after its last accepted photograph it does [days]."
    )
    attention_camera_ratio: float = Field(
        default=1.5,
        gt=1,
        le=100,
        description="A camera changed where its photographs' signal, noise or sheet is that many times what it was.",
    )
    attention_camera_certainty: float = Field(
        default=6.0, gt=0, le=100, description="How sure that must be [standard deviations, from day to day]."
    )
    attention_camera_days: int = Field(
        default=5,
        ge=2,
        le=30,
        description="Days with photographs since the change, and at least twice as many before it, that tell it.",
    )
    attention_queue_s: float = Field(
        default=1800.0, gt=0, le=1e7, description="The queue is stuck where a job has waited for so long [s]."
    )
    metrics_port: int | None = Field(
        default=None,
        ge=1,
        le=65535,
        description="A port of its own for this process's metrics, without a key; `worker` has no other.",
    )
    metrics_host: str = Field(default="127.0.0.1", description="Address that this port listens on.")
    metrics_heliostats: int = Field(
        default=1000, ge=0, le=100_000, description="Most heliostats whose drift is told, the worst ones."
    )
    otlp_endpoint: str | None = Field(
        default=None, pattern="^https?://", description="OpenTelemetry collector for traces; needs heliotwin[otel]."
    )

    @field_validator("database_url")
    @classmethod
    def _known_database(cls, value: str | None) -> str | None:
        if value is None:
            return None
        try:
            backend = make_url(value).get_backend_name()
        except ArgumentError as error:
            raise ValueError("must be a database URL such as postgresql://user@host/name") from error
        if backend not in _DRIVERS:
            raise ValueError(f"must be a sqlite or postgresql URL, not {backend}")
        return value

    @field_validator("map_scales")
    @classmethod
    def _all_scales(cls, value: dict[str, tuple[float, float]]) -> dict[str, tuple[float, float]]:
        unknown = sorted(set(value) - set(MAP_SCALES))
        if unknown:
            raise ValueError(f"there is no figure {', '.join(unknown)}; name {', '.join(MAP_SCALES)}")
        for name, (fine, poor) in value.items():
            fine_is_high = MAP_SCALES[name][1] < MAP_SCALES[name][0]
            if (poor < fine) is not fine_is_high or fine == poor or not math.isfinite(fine - poor):
                raise ValueError(f"{name}: give what is fine, then what is poor, not {fine:g}, {poor:g}")
        return MAP_SCALES | value

    @field_validator("figure_scales")
    @classmethod
    def _all_ends(cls, value: dict[str, float]) -> dict[str, float]:
        unknown = sorted(set(value) - set(FIGURE_SCALES))
        if unknown:
            raise ValueError(f"there is no scale {', '.join(unknown)}; name {', '.join(FIGURE_SCALES)}")
        for name, end in value.items():
            if not 0 < end < math.inf:
                raise ValueError(f"{name}: give where the colours end, more than 0, not {end:g}")
        return FIGURE_SCALES | value

    @field_validator("time_zone")
    @classmethod
    def _known_zone(cls, value: str | None) -> str | None:
        try:
            return None if value is None else ZoneInfo(value).key
        except (ZoneInfoNotFoundError, ValueError, OSError) as error:
            raise ValueError(f"must be a zone of the tz database such as Europe/Berlin, not {value!r}") from error

    @field_validator("forwarded_allow_ips")
    @classmethod
    def _known_proxies(cls, value: str) -> str:
        networks_of(value)
        return value

    @model_validator(mode="after")
    def _enough_connections(self) -> Self:
        """With fewer, workers could hold all there are, and requests and heartbeats would wait for them."""
        least = _LEAST_WEB_CONNECTIONS + WORKER_CONNECTIONS * self.job_workers
        if self.database_connections is not None and self.database_connections < least:
            raise ValueError(
                f"database_connections: {self.database_connections} are too few for job_workers {self.job_workers}; "
                f"set at least {least}"
            )
        return self

    @property
    def trusted_proxies(self) -> tuple[Network, ...]:
        """Whose word on the sender of a request is believed."""
        return networks_of(self.forwarded_allow_ips) if self.proxy_headers else ()

    @property
    def connections(self) -> int:
        """Most database connections of this process."""
        return self.database_connections or WEB_CONNECTIONS + WORKER_CONNECTIONS * self.job_workers

    @property
    def password(self) -> SecretStr | None:
        """The database password from its file, where one is named."""
        if self.database_password_file is None:
            return None
        return SecretStr(self.database_password_file.read_text(encoding="utf-8").strip())

    @property
    def database(self) -> URL:
        """The database URL with its driver and password filled in."""
        if self.database_url is None:
            return URL.create("sqlite", database=str(self.data_dir / "heliotwin.sqlite"))
        url = make_url(self.database_url)
        url = url.set(drivername=_DRIVERS[url.get_backend_name()])
        return url if self.password is None else url.set(password=self.password.get_secret_value())

    @property
    def in_force(self) -> list[Shown]:
        """All of them by the names of the environment, without secrets."""
        fields = type(self).model_fields.items()
        return [
            Shown(
                f"{self.model_config['env_prefix']}{name.upper()}",
                "" if (value := getattr(self, name)) is None else _harmless(value),
                name in self.model_fields_set,
                field.description or "",
            )
            for name, field in fields
        ]

    @property
    def migrates_on_start(self) -> bool:
        """Whether the service migrates by itself; on a shared database a one-shot ``heliotwin migrate`` does."""
        if self.migrate_on_start is not None:
            return self.migrate_on_start
        return self.database.get_backend_name() == "sqlite"
