"""Roles, the identity behind a request, and the role that each route requires.

A request presents its key in ``Authorization: Bearer KEY``. A page presents its session in the
cookie that ``POST /session`` sets. `service.web.middleware.AuthMiddleware` identifies the sender
before the body is read. `Requires` on each route then checks the role. The service does not start
if a route neither declares a role nor is listed in `PUBLIC`.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from typing import Annotated, Any

from fastapi import FastAPI, HTTPException, Request, Security
from fastapi.routing import iter_route_contexts
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer

from service.base.errors import UnauthenticatedExposureError
from service.base.settings import Settings, is_loopback
from service.store import keys, sessions
from service.store.database import Database
from service.store.job_tables import ROLES

COOKIE = "heliotwin_session"

PUBLIC = ("/livez", "/readyz", "/openapi.json", "/docs", "/session", "/login", "/logout", "/static")
"""Paths that need no key, including all paths below them.

None of them shows or changes data of the plant.
"""

GUIDE = "/docs/guide/"
"""The guide, which needs a key like all pages, although it is below a public path."""


HEALTH = ("/livez", "/readyz")
"""Probes of process supervisors, without a rate limit.

They are cheap, and `/readyz` has one separate thread.
"""


class Role(StrEnum):
    """What a key may do. Each role includes the roles before it."""

    READ = "read"
    """Read everything except the audit trail: dashboards."""
    INGEST = "ingest"
    """Post photographs, for the calibration system. It reads flux, quality and surface back."""
    OPERATE = "operate"
    """Predict, forecast, study, adopt effects, run and cancel jobs, and change the plant.

    For operators and aim-point software. Targets and heliostats are part of the plant.
    """
    ADMIN = "admin"
    """Read the audit trail: the person responsible for the plant."""

    def includes(self, other: "Role") -> bool:
        """Whether this role includes ``other``."""
        return ROLES.index(self) >= ROLES.index(other)


@dataclass(frozen=True)
class Identity:
    """The sender of a request: the name and the role of its key.

    ``unrecorded`` is the id of a key of which a use is to be recorded.
    """

    name: str
    role: Role
    unrecorded: int | None = None


LOCAL = Identity(keys.RESERVED, Role.ADMIN)
"""The identity of requests without a key, if no key is required."""


def is_public(path: str) -> bool:
    """Whether a path needs no key."""
    below = f"{path}/"
    return any(below.startswith(f"{public}/") for public in PUBLIC) and not below.startswith(GUIDE)


def presented_key(headers: Mapping[str, str]) -> str | None:
    """The key in the request header, else the session in the cookie, or None."""
    scheme, _, token = headers.get("authorization", "").partition(" ")
    if scheme:
        return (
            token.strip()
            if scheme.lower() == "bearer" and not sessions.is_token(token.strip())
            else ""
        )
    return presented_session(headers)


def presented_session(headers: Mapping[str, str]) -> str | None:
    """The session in the request cookie.

    None if there is no cookie, and empty if the cookie holds something else.
    """
    try:
        morsel = SimpleCookie(headers.get("cookie", "")).get(COOKIE)
    except CookieError:
        return None
    return None if morsel is None else morsel.value if sessions.is_token(morsel.value) else ""


_FORWARDED = ("forwarded", "via", "x-real-ip")


def is_forwarded(headers: Mapping[str, str]) -> bool:
    """Whether a proxy forwarded the request, trusted or not.

    The client behind a proxy may be anywhere.
    """
    return any(
        name.lower() in _FORWARDED or name.lower().startswith("x-forwarded-") for name in headers
    )


def may_be_open(settings: Settings) -> bool:
    """Whether access without a key is allowed while no key exists.

    It is allowed if only this machine can connect, or if the settings allow an open network.
    """
    return is_loopback(settings.host) or settings.allow_open_network


def identify(
    database: Database, settings: Settings, presented: str | None, is_direct: bool = True
) -> Identity | None:
    """Identify the sender of a request by its key or session.

    Without a key, the sender is `LOCAL` if the request came directly, no key exists and the
    settings allow it. None for everyone else.
    """
    with database.reading() as session:
        if presented is not None:
            row = keys.find(session, presented) or sessions.find_key(session, presented)
            if row is None:
                return None
            return Identity(row.name, Role(row.role), row.id if keys.is_use_due(row) else None)
        if is_direct and may_be_open(settings) and not keys.any_made(session):
            return LOCAL
    return None


def refuse_unauthenticated_exposure(settings: Settings, database: Database) -> None:
    """Refuse to expose the service to other machines without a key.

    Raises
    ------
    UnauthenticatedExposureError
        If other machines can connect, no valid key exists and the settings do not allow it.
    """
    if may_be_open(settings):
        return
    with database.reading() as session:
        if not keys.any_valid(session):
            raise UnauthenticatedExposureError(
                f"host {settings.host} is reachable from other machines and the store holds no key:"
                " make one by `heliotwin keys create NAME --role admin`, or listen on 127.0.0.1,"
                " or set HELIOTWIN_ALLOW_OPEN_NETWORK=true"
            )


_bearer = HTTPBearer(auto_error=False, description="A key made by `heliotwin keys create`.")


class Requires:
    """Dependency that requires at least this role."""

    def __init__(self, role: Role) -> None:
        self.role = role

    async def __call__(
        self,
        request: Request,
        _documented: Annotated[HTTPAuthorizationCredentials | None, Security(_bearer)],
    ) -> Identity:
        """Return the identity; 401 without one, 403 if its role is too low."""
        identity: Identity | None = getattr(request.state, "identity", None)
        require_role(identity, self.role)
        assert identity is not None
        return identity


def require_role(identity: Identity | None, role: Role | None) -> None:
    """Require that ``identity`` has at least ``role``; None requires nothing.

    Raises
    ------
    HTTPException
        401 without an identity, 403 if its role is too low.
    """
    if role is None:
        return
    if identity is None:
        raise HTTPException(
            HTTPStatus.UNAUTHORIZED, "present a key", {"WWW-Authenticate": "Bearer"}
        )
    if not identity.role.includes(role):
        detail = f"key {identity.name} has the role {identity.role}; this needs {role}"
        raise HTTPException(
            HTTPStatus.FORBIDDEN, detail, {"WWW-Authenticate": 'Bearer error="insufficient_scope"'}
        )


def _calls(dependant: Any) -> Iterator[Any]:
    yield dependant.call
    for inner in dependant.dependencies:
        yield from _calls(inner)


def dependencies_of(route: Any) -> Sequence[Any]:
    """All callables that a route depends on, including its endpoint.

    Empty if ``route`` is not a FastAPI route.
    """
    dependant = getattr(route, "dependant", None)
    return () if dependant is None else tuple(_calls(dependant))


def role_of(route: Any) -> Role | None:
    """The role that a route declares, or None."""
    found = [call.role for call in dependencies_of(route) if isinstance(call, Requires)]
    return max(found, key=ROLES.index, default=None)


def declared_roles(app: FastAPI) -> dict[tuple[str, str], Role | None]:
    """The declared role of each route (method, path), or None."""
    roles: dict[tuple[str, str], Role | None] = {}
    for context in iter_route_contexts(app.routes):
        for method in context.methods or {"*"}:  # a mounted application accepts any method
            roles[method, str(context.path)] = role_of(context)
    return roles


def require_declared_roles(app: FastAPI) -> None:
    """Raise LookupError if a route neither declares a role nor is public."""
    for (method, path), role in declared_roles(app).items():
        if role is None and not is_public(path):
            raise LookupError(
                f"{method} {path} declares no role: give it dependencies=[READ], or another of its"
                " kind"
            )
