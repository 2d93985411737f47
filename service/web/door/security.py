"""Who may do what: roles, who a request comes from, and the role that each route needs.

A request shows its key in ``Authorization: Bearer KEY``, or in the cookie that ``POST /session`` sets for pages.
`service.web.middleware.DoorMiddleware` finds out who it is before the body is read; `Requires` on each route then asks
whether that is enough. A route that declares neither a role nor stands in `PUBLIC` keeps the service from starting.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from typing import Annotated, Any

from fastapi import FastAPI, HTTPException, Request, Security
from fastapi.routing import iter_route_contexts
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer

from service.base.faults import OpenDoorError
from service.base.settings import Settings, is_loopback
from service.store import keys
from service.store.database import Database
from service.store.job_tables import ROLES

COOKIE = "heliotwin_key"

PUBLIC = ("/livez", "/readyz", "/openapi.json", "/docs", "/session", "/login", "/logout", "/static")
"""Paths that need no key, with all that lies below them; none shows or changes anything of the plant."""


HEALTH = ("/livez", "/readyz")
"""What supervisors ask, as often as they like; it costs little, and `/readyz` has one thread of its own."""


class Role(StrEnum):
    """What a key may do; each role may also do what those before it may."""

    READ = "read"
    """Read everything but the audit trail: dashboards."""
    INGEST = "ingest"
    """Post photographs: the calibration system, which reads back flux, quality and surface."""
    OPERATE = "operate"
    """Predict, forecast, study, adopt effects, run and cancel jobs, change plant, targets and heliostats: operators,
    aim-point software."""
    ADMIN = "admin"
    """Read the audit trail: whoever answers for the plant."""

    def includes(self, other: "Role") -> bool:
        """Whether this role may do what ``other`` may."""
        return ROLES.index(self) >= ROLES.index(other)


@dataclass(frozen=True)
class Identity:
    """Who a request comes from: the name of its key."""

    name: str
    role: Role


LOCAL = Identity(keys.RESERVED, Role.ADMIN)
"""Whoever comes without a key where none is demanded."""


def is_public(path: str) -> bool:
    """Whether a path is open to everybody."""
    return any(path == public or path.startswith(f"{public}/") for public in PUBLIC)


def presented_key(headers: Mapping[str, str]) -> str | None:
    """The key in the request's header, else in its cookie; None where there is neither."""
    scheme, _, token = headers.get("authorization", "").partition(" ")
    if scheme:
        return token.strip() if scheme.lower() == "bearer" else ""
    try:
        morsel = SimpleCookie(headers.get("cookie", "")).get(COOKIE)
    except CookieError:
        return None
    return None if morsel is None else morsel.value


_FORWARDED = ("forwarded", "via", "x-real-ip")


def is_forwarded(headers: Mapping[str, str]) -> bool:
    """Whether a proxy sent the request on, trusted or not: whoever stands behind it may be anywhere."""
    return any(name.lower() in _FORWARDED or name.lower().startswith("x-forwarded-") for name in headers)


def may_be_open(settings: Settings) -> bool:
    """Whether access without a key is allowed while no key was made: this machine only, or acknowledged."""
    return is_loopback(settings.host) or settings.allow_open_network


def identify(database: Database, settings: Settings, presented: str | None, is_direct: bool = True) -> Identity | None:
    """Who presented this key, or who may come without one, directly and not by a proxy; None for everybody else."""
    with database.reading() as session:
        if presented is not None:
            row = keys.find(session, presented)
            return None if row is None else Identity(row.name, Role(row.role))
        if is_direct and may_be_open(settings) and not keys.any_made(session):
            return LOCAL
    return None


def require_closed_door(settings: Settings, database: Database) -> None:
    """OpenDoorError where others can reach the service, it has no key, and nobody acknowledged that."""
    if may_be_open(settings):
        return
    with database.reading() as session:
        if not keys.any_valid(session):
            raise OpenDoorError(
                f"host {settings.host} is reachable from other machines and the store holds no key: make one by "
                "`heliotwin keys create NAME --role admin`, or listen on 127.0.0.1, or set "
                "HELIOTWIN_ALLOW_OPEN_NETWORK=true"
            )


_bearer = HTTPBearer(auto_error=False, description="A key made by `heliotwin keys create`.")


class Requires:
    """A dependency that lets in whoever has at least this role."""

    def __init__(self, role: Role) -> None:
        self.role = role

    async def __call__(
        self, request: Request, _documented: Annotated[HTTPAuthorizationCredentials | None, Security(_bearer)]
    ) -> Identity:
        """The request's identity; 401 without one, 403 where its role is not enough."""
        identity: Identity | None = getattr(request.state, "identity", None)
        if identity is None:
            raise HTTPException(HTTPStatus.UNAUTHORIZED, "present a key", {"WWW-Authenticate": "Bearer"})
        if not identity.role.includes(self.role):
            detail = f"key {identity.name} has the role {identity.role}; this needs {self.role}"
            challenge = {"WWW-Authenticate": 'Bearer error="insufficient_scope"'}
            raise HTTPException(HTTPStatus.FORBIDDEN, detail, challenge)
        return identity


def _calls(dependant: Any) -> Iterator[Any]:
    yield dependant.call
    for inner in dependant.dependencies:
        yield from _calls(inner)


def declared_roles(app: FastAPI) -> dict[tuple[str, str], Role | None]:
    """The role that each route (method, path) declares; None where it declares none."""
    roles: dict[tuple[str, str], Role | None] = {}
    for context in iter_route_contexts(app.routes):
        calls = _calls(context.dependant) if getattr(context, "dependant", None) is not None else ()
        found = [call.role for call in calls if isinstance(call, Requires)]
        for method in context.methods or {"*"}:  # a mounted application takes any, and declares no role
            roles[method, str(context.path)] = max(found, key=ROLES.index, default=None)
    return roles


def require_declared_roles(app: FastAPI) -> None:
    """LookupError unless every route declares a role or is public on purpose."""
    for (method, path), role in declared_roles(app).items():
        if role is None and not is_public(path):
            raise LookupError(f"{method} {path} declares no role: give it dependencies=[READ], or another of its kind")
