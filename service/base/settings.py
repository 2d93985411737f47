"""Settings of the service, from the environment (prefix ``HELIOTWIN_``) or a ``.env`` file."""

import ipaddress
import math
import shlex
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Self
from urllib.parse import urlsplit
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

from pydantic import Field, SecretStr, field_validator, model_validator
from pydantic_settings import BaseSettings, SettingsConfigDict
from sqlalchemy import URL, make_url
from sqlalchemy.exc import ArgumentError

Network = ipaddress.IPv4Network | ipaddress.IPv6Network

LogLevel = Literal["critical", "error", "warning", "info", "debug"]

_DRIVERS = {"sqlite": "sqlite", "postgresql": "postgresql+psycopg"}

WEB_CONNECTIONS = 48
"""Database connections of a process without workers.

The routes run in 40 threads with one connection each. The others serve checks of keys, job events
and readiness probes.
"""

WORKER_CONNECTIONS = 2
"""Database connections of a worker: one for its work and one for its heartbeat."""

_MIN_WEB_CONNECTIONS = 8

MAP_SCALES: dict[str, tuple[float, float]] = {
    "accuracy": (95.0, 75.0),
    "deviation_mm": (0.0, 2.0),
    "uncertainty_mm": (0.0, 0.5),
    "misfit": (5.0, 30.0),
    "age_days": (0.0, 365.0),
    "pointing_error_mrad": (0.0, 3.0),
    "sun_span_deg": (60.0, 0.0),
}
"""Default ends (good, poor) of the colour scales on the field map."""

FIGURE_SCALES: dict[str, float] = {
    "heights": 2.0,
    "height_change": 1.0,
    "height_std": 0.5,
    "flux_difference": 0.3,
    "mean_difference": 0.1,
}
"""Default ends of symmetric colour scales.

Heights of a mirror, their change and their standard deviation are in [mm]. Differences between
forecast and photograph are in [1] of the measured peak, for one photograph and for the mean.
"""


def address_of(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    """The address that ``host`` is; None for a name."""
    try:
        return ipaddress.ip_address(host)
    except ValueError:
        return None


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach a server that listens on ``host``."""
    address = address_of(host)  # a name may resolve to any address
    return host == "localhost" or (address is not None and address.is_loopback)


def networks_of(text: str) -> Sequence[Network]:
    """Parse addresses and networks that are separated by commas.

    Raises
    ------
    ValueError
        For anything else, including `*`, which would trust everybody.
    """
    return tuple(ipaddress.ip_network(part.strip()) for part in text.split(","))


def is_within(host: str, networks: Iterable[Network]) -> bool:
    """Whether ``host`` is an address in one of these networks."""
    address = address_of(host)
    return address is not None and any(address in network for network in networks)


@dataclass(frozen=True)
class SettingValue:
    """A current setting for display; ``is_set`` if it is not a default."""

    name: str
    value: str
    is_set: bool
    about: str


def _redact(value: Any) -> str:
    """A value as text. URLs lose their password and query, which may contain secrets."""
    if isinstance(value, str) and "://" in value:
        url = make_url(value)
        text = url.set(query={}).render_as_string(hide_password=True)
        return f"{text}?***" if url.query else text
    if isinstance(value, dict):
        return ", ".join(f"{name} {_redact(inner)}" for name, inner in value.items())
    if isinstance(value, tuple):
        return " to ".join(map(_redact, value))
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.15g}" if isinstance(value, float) else str(value)


Days = Annotated[float, Field(ge=0, le=36500)]


class _SettingsGroup(BaseSettings):
    """A group of settings. The docstring of a field is its description."""

    model_config = SettingsConfigDict(
        env_prefix="HELIOTWIN_",
        env_file=".env",
        extra="ignore",
        frozen=True,
        env_ignore_empty=True,
        use_attribute_docstrings=True,
    )


class StorageSettings(_SettingsGroup):
    """Database and files."""

    data_dir: Path = Path("heliotwin-data")
    """Folder of the images and of the embedded database."""
    database_url: str | None = None
    """sqlite:///FILE or postgresql://USER@HOST/NAME; without it SQLite inside data_dir."""
    database_password_file: Path | None = None
    """File holding the database password, so that no URL or environment does."""
    database_connections: int | None = Field(None, ge=1, le=1000)
    """Most connections of this process, at least 8 and 2 for each of its job_workers and
    short_job_workers; without it 48 and 2 for each. PostgreSQL's max_connections must hold those of
    all processes."""
    networks_dir: Path | None = None
    """Folder of the networks of heliostat types; without it networks inside data_dir."""
    effects_from: tuple[Path, ...] = ()
    """JSON: files of effects that the plant wrote, such as ["/etc/heliotwin/own.py"]. They are
    code that the service runs: name only those that you have read."""
    migrate_on_start: bool | None = None
    """Bring the schema to its newest version at start; without it only SQLite is migrated."""

    @field_validator("database_url")
    @classmethod
    def _known_database(cls, value: str | None) -> str | None:
        if value is None:
            return None
        try:
            backend = make_url(value).get_backend_name()
        except ArgumentError as error:
            raise ValueError(
                "must be a database URL such as postgresql://user@host/name"
            ) from error
        if backend not in _DRIVERS:
            raise ValueError(f"must be a sqlite or postgresql URL, not {backend}")
        return value

    @property
    def password(self) -> SecretStr | None:
        """The database password from its file, if the settings name one."""
        if self.database_password_file is None:
            return None
        return SecretStr(self.database_password_file.read_text(encoding="utf-8").strip())

    @property
    def networks(self) -> Path:
        """The folder of the networks of heliostat types."""
        return self.networks_dir or self.data_dir / "networks"

    @property
    def database(self) -> URL:
        """The database URL with driver and password."""
        if self.database_url is None:
            return URL.create("sqlite", database=str(self.data_dir / "heliotwin.sqlite"))
        url = make_url(self.database_url)
        url = url.set(drivername=_DRIVERS[url.get_backend_name()])
        return url if self.password is None else url.set(password=self.password.get_secret_value())

    @property
    def store(self) -> str:
        """The setting that names this store from any folder, without secrets."""
        if self.database_url is None:
            return f"HELIOTWIN_DATA_DIR={shlex.quote(str(self.data_dir.absolute()))}"
        return f"HELIOTWIN_DATABASE_URL={shlex.quote(_redact(self.database_url))}"

    @property
    def uploads_dir(self) -> Path:
        """Folder of uploaded measurement folders, until they are imported."""
        return self.data_dir / "uploads"

    @property
    def migrates_on_start(self) -> bool:
        """Whether the service migrates the schema at start.

        By default it does so for SQLite. On a shared database an operator runs ``heliotwin
        migrate`` once.
        """
        if self.migrate_on_start is not None:
            return self.migrate_on_start
        return self.database.get_backend_name() == "sqlite"


class NetworkSettings(_SettingsGroup):
    """Addresses to listen on, host names and proxies."""

    host: str = "127.0.0.1"
    """Address to listen on."""
    port: int = Field(8000, ge=1, le=65535)
    """Port to listen on."""
    allow_open_network: bool = False
    """Unsafe: while no key exists, every client of a non-loopback host may read and write
    everything."""
    allowed_hosts: str = ""
    """Names of this service, with commas between, that requests without a key may name as their
    Host while no key was made; addresses and localhost always are."""
    proxy_headers: bool = True
    """Trust X-Forwarded-For and X-Forwarded-Proto of the proxies in forwarded_allow_ips."""
    forwarded_allow_ips: str = "127.0.0.1,::1"
    """Addresses and networks of trusted proxies, with commas between; never one that clients come
    from."""

    @field_validator("forwarded_allow_ips")
    @classmethod
    def _known_proxies(cls, value: str) -> str:
        networks_of(value)
        return value

    @property
    def trusted_proxies(self) -> Sequence[Network]:
        """Networks of proxies whose headers about the sender are trusted."""
        return networks_of(self.forwarded_allow_ips) if self.proxy_headers else ()

    def is_own_host(self, host: str) -> bool:
        """Whether a Host header names this service by a name that nobody else controls.

        This prevents DNS rebinding: the owner of another site could point a name at this machine.
        Pages of that site could then read and write with the rights of a local page. IP addresses
        are safe.
        """
        try:
            name = (urlsplit(f"//{host}").hostname or "").rstrip(".")
        except ValueError:
            return False
        if name in ("localhost", self.host.lower(), *self.own_names):
            return bool(name)
        return address_of(name) is not None

    @property
    def own_names(self) -> Sequence[str]:
        """The names of `allowed_hosts`."""
        return tuple(name.strip().lower() for name in self.allowed_hosts.split(",") if name.strip())


class LimitSettings(_SettingsGroup):
    """Limits on requests."""

    max_image_bytes: int = Field(32 * 2**20, ge=1024)
    """Largest image accepted [bytes]."""
    max_image_pixels: int = Field(50_000_000, ge=1024)
    """Largest image accepted, width x height [pixels]."""
    max_json_bytes: int = Field(2**20, ge=1024)
    """Largest request body that is not an image [bytes]."""
    requests_per_s: float = Field(200.0, gt=0, le=1e6)
    """Requests of one key each second; 64 KiB of answers count as one. While no key was made, all
    requests count as one key's."""
    requests_burst: int = Field(400, ge=1, le=10**6)
    """Most of them at once after a pause."""
    public_requests_per_s: float = Field(20.0, gt=0, le=1e6)
    """Requests of one address (a /64 with IPv6) to public paths each second, and as many with wrong
    keys; 64 KiB of answers count as one. /livez and /readyz have no limit."""
    public_requests_burst: int = Field(200, ge=1, le=10**6)
    """Most of them at once after a pause."""
    max_connections: int = Field(1000, ge=10, le=100_000)
    """Open connections beyond which requests are answered 503."""
    max_watchers: int = Field(200, ge=1, le=10_000)
    """Jobs that are followed at a time (event streams); 503 beyond."""
    max_watchers_of_key: int = Field(50, ge=1, le=10_000)
    """Those of one key, or of all without a key; 429 beyond."""
    max_connections_each: int = Field(100, ge=1, le=100_000)
    """Those of one address, of a /64 with IPv6; this machine and trusted proxies have no such
    bound."""
    max_uploads_of_key: int = Field(32, ge=1, le=10_000)
    """Photographs that one key may be sending at a time; 429 beyond."""
    max_body_bytes_of_key: int = Field(256 * 2**20, ge=1024)
    """Bytes of bodies of one key that are not answered yet; 429 beyond. Also the largest ZIP file
    of a measurement folder."""
    max_body_bytes: int = Field(768 * 2**20, ge=1024)
    """Those of all keys, which the temporary folder must hold; 503 beyond."""
    max_unpacked_bytes: int = Field(2 * 2**30, ge=1024)
    """Largest measurement folder in a ZIP file, unpacked [bytes]."""
    min_bytes_per_s: float = Field(4096.0, gt=0, le=1e9)
    """Bytes of a body that must come each second, on the whole [bytes/s]."""

    @model_validator(mode="after")
    def _room_for_photographs(self) -> Self:
        """Require space for a photograph per key, and no more per key than in total."""
        least = self.max_image_bytes + 2**20
        if not least <= self.max_body_bytes_of_key <= self.max_body_bytes:
            raise ValueError(
                f"max_body_bytes_of_key: {self.max_body_bytes_of_key} must lie between {least}"
                f" (max_image_bytes and 1 MiB) and max_body_bytes, {self.max_body_bytes}"
            )
        return self


class JobSettings(_SettingsGroup):
    """Computations and background jobs."""

    parallel_computations: int = Field(2, ge=1, le=64)
    """Measurements, predictions and tracings at a time."""
    ray_address: str | None = Field(None, min_length=1)
    """HOST:PORT of a Ray cluster that works at fleet forecasts, `local` for one of this machine's;
    without it threads do."""
    job_workers: int = Field(1, ge=0, le=64)
    """Jobs that `serve` works at itself at a time; 0 where `worker` does."""
    job_lease_s: float = Field(30.0, ge=0.5, le=3600)
    """A worker that was silent for so long [s] has lost its job."""
    job_silence_s: float = Field(3600.0, ge=0.5, le=604_800)
    """A job without progress for so long [s] hangs: its worker requeues it and ends."""
    job_poll_s: float = Field(0.5, ge=0.05, le=60)
    """How often workers look for jobs [s]."""
    job_attempts: int = Field(3, ge=1, le=20)
    """How often a job is tried before it has failed."""
    job_retry_s: float = Field(5.0, ge=0, le=600)
    """Pause before the second attempt [s]; it doubles from then on."""
    short_job_workers: int = Field(1, ge=0, le=64)
    """Workers in addition to job_workers that take short jobs only; 0 lets those wait for long
    ones."""
    short_job_s: float = Field(10.0, ge=0, le=3600)
    """A job that is expected to take at most so long is short [s]."""
    max_queued_jobs: int = Field(1000, ge=1)
    """Most jobs that may wait."""
    max_queued_jobs_of_key: int = Field(200, ge=1)
    """Most of them of one key, or of all without a key; 429 beyond."""
    import_root: Path | None = None
    """Folder whose subfolders jobs may import; without it no job imports."""

    @property
    def all_workers(self) -> int:
        """Number of workers including those for short jobs; 0 if ``job_workers`` is 0."""
        return self.job_workers + self.short_job_workers if self.job_workers else 0


class RetentionSettings(_SettingsGroup):
    """How long records and images are stored."""

    job_retention_days: Days = 90.0
    """Jobs that ended so long ago [days] are deleted, but for plans that are done; 0 keeps all."""
    plan_retention_days: Days = 365.0
    """Plans made so long ago [days] are deleted with their maps; 0 keeps all."""
    forecast_retention_days: Days = 365.0
    """Forecasts made so long ago [days] are deleted; 0 keeps all."""
    refused_image_retention_days: Days = 90.0
    """Refused photographs so old [days] lose their image; 0 keeps all."""
    image_retention_days: Days = 730.0
    """Accepted photographs so old [days] lose their image, unless the active surface was made
    from them; 0 keeps all."""
    image_quota_gb: float = Field(2000.0, ge=0, le=1e6)
    """Most that images may take [GB]; beyond it the oldest go, refused ones first, but never what
    active surfaces were made from. 0 sets no bound."""
    audit_retention_days: Days = 1825.0
    """Audit entries so old [days] are deleted; 0 keeps all."""


class DisplaySettings(_SettingsGroup):
    """Logs and pages."""

    log_level: LogLevel = "info"
    """The least that is logged."""
    log_format: Literal["text", "json"] = "text"
    """json: one object a line."""
    time_zone: str | None = None
    """The plant's zone, as `Europe/Berlin`: pages show times in it and in UTC."""
    map_scales: dict[str, tuple[float, float]] = Field(default_factory=dict, validate_default=True)
    """JSON: what is fine and what is poor, which the map marks on its colours, of accuracy [%],
    deviation_mm, uncertainty_mm, misfit [%], age_days, pointing_error_mrad and sun_span_deg, such
    as {"accuracy": [95, 80]}. The colours span the field's values, up to what is poor."""
    figure_scales: dict[str, float] = Field(default_factory=dict, validate_default=True)
    """JSON: where the colours of maps end, on all pages alike, of heights, height_change and
    height_std [mm], flux_difference and mean_difference [share of the measured peak], such as
    {"heights": 3}; what lies beyond has the end colours, and is reported."""

    @field_validator("map_scales")
    @classmethod
    def _all_scales(cls, value: dict[str, tuple[float, float]]) -> dict[str, tuple[float, float]]:
        unknown = sorted(set(value) - set(MAP_SCALES))
        if unknown:
            raise ValueError(
                f"there is no figure {', '.join(unknown)}; name {', '.join(MAP_SCALES)}"
            )
        for name, (fine, poor) in value.items():
            fine_is_high = MAP_SCALES[name][1] < MAP_SCALES[name][0]
            if (poor < fine) is not fine_is_high or fine == poor or not math.isfinite(fine - poor):
                raise ValueError(
                    f"{name}: give what is fine, then what is poor, not {fine:g}, {poor:g}"
                )
        return MAP_SCALES | value

    @field_validator("figure_scales")
    @classmethod
    def _all_ends(cls, value: dict[str, float]) -> dict[str, float]:
        unknown = sorted(set(value) - set(FIGURE_SCALES))
        if unknown:
            raise ValueError(
                f"there is no scale {', '.join(unknown)}; name {', '.join(FIGURE_SCALES)}"
            )
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
            raise ValueError(
                f"must be a zone of the tz database such as Europe/Berlin, not {value!r}"
            ) from error


class AlarmSettings(_SettingsGroup):
    """When a heliostat, a camera or the queue raises an alarm."""

    alarm_accuracy: float = Field(0.75, ge=0, le=1)
    """Forecast accuracy below which a heliostat has an alarm [1]."""
    alarm_accuracy_drop: float = Field(0.05, ge=0, le=1)
    """By how much more than this the accuracy of a heliostat's newest photographs must have fallen
    [1], surely (95 %), for an alarm."""
    alarm_light_loss: float = Field(0.2, gt=0, lt=1)
    """The same for the share of light that its newest photographs have lost, compared with other
    heliostats on the same days [1]."""
    default_pointing_error_mrad: float = Field(0.5, ge=0, lt=100)
    """Pointing error in forecasts of the field, plans and aims of a heliostat whose photographs and
    properties give none: standard deviation of its beam per axis [mrad]."""
    alarm_pointing_mrad: float = Field(3.0, gt=0, le=1000)
    """Pointing error above which a heliostat has an alarm [mrad]."""
    alarm_moved_days: Days = 90.0
    """How long the alarm of a heliostat that moved lasts [days]."""
    alarm_photograph_days: float = Field(30.0, gt=0, le=36500)
    """Age of the last accepted photograph above which a heliostat has an alarm [days]."""
    alarm_camera_ratio: float = Field(1.5, gt=1, le=100)
    """A camera changed where its photographs' signal, noise or sheet is that many times what it
    was."""
    alarm_camera_certainty: float = Field(6.0, gt=0, le=100)
    """How sure that must be [standard deviations, from day to day]."""
    alarm_camera_days: int = Field(5, ge=2, le=30)
    """Days with photographs since the change, and at least twice as many before it."""
    alarm_queue_s: float = Field(1800.0, gt=0, le=1e7)
    """The queue is stuck where a job has waited for so long [s]."""


class MonitoringSettings(_SettingsGroup):
    """Metrics and traces."""

    metrics_port: int | None = Field(None, ge=1, le=65535)
    """A separate port for this process's metrics, without a key; `worker` has no other."""
    metrics_host: str = "127.0.0.1"
    """Address that this port listens on."""
    metrics_heliostats: int = Field(1000, ge=0, le=100_000)
    """Most heliostats whose drift is reported, the worst ones."""
    otlp_endpoint: str | None = Field(None, pattern="^https?://")
    """OpenTelemetry collector for traces; needs heliotwin[otel]."""


class Settings(
    MonitoringSettings,
    AlarmSettings,
    DisplaySettings,
    RetentionSettings,
    JobSettings,
    LimitSettings,
    NetworkSettings,
    StorageSettings,
):
    """Settings of the operator. Unsafe combinations are rejected at start.

    The fields of the last base are listed first.
    """

    @model_validator(mode="after")
    def _enough_connections(self) -> Self:
        """Require enough database connections for workers, requests and heartbeats."""
        least = _MIN_WEB_CONNECTIONS + WORKER_CONNECTIONS * self.all_workers
        if self.database_connections is not None and self.database_connections < least:
            raise ValueError(
                f"database_connections: {self.database_connections} are too few for job_workers"
                f" {self.job_workers} and those for short jobs; set at least {least}"
            )
        return self

    @property
    def connections(self) -> int:
        """Maximum number of database connections of this process."""
        return self.database_connections or WEB_CONNECTIONS + WORKER_CONNECTIONS * self.all_workers

    @property
    def in_force(self) -> list[SettingValue]:
        """All settings by the names of their environment variables, without secrets."""
        fields = type(self).model_fields.items()
        return [
            SettingValue(
                f"{self.model_config['env_prefix']}{name.upper()}",
                "" if (value := getattr(self, name)) is None else _redact(value),
                name in self.model_fields_set,
                " ".join((field.description or "").split()),
            )
            for name, field in fields
        ]
