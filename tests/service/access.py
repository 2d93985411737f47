"""Keys of a service, and the routes that need one."""

from fastapi import FastAPI

from service.base.settings import Settings
from service.store import keys
from service.web.app import create_app
from service.web.auth import security


def make_key(app: FastAPI, name: str, role: str = "admin") -> str:
    with app.state.runtime.database.writing() as session:
        return keys.create(session, name, role, "tester")


def withdraw(app: FastAPI, name: str) -> None:
    with app.state.runtime.database.writing() as session:
        keys.withdraw(session, name, "tester")


def bearer(key: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {key}"}


def all_routes() -> list[tuple[str, str]]:
    return [
        route
        for route in security.declared_roles(create_app(Settings()))
        if not security.is_public(route[1])
    ]
