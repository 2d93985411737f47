"""A store with something in it."""

from datetime import UTC, datetime

from sqlalchemy import URL

from service.base.fields import Sun
from service.sources.photograph import IncomingPhotograph
from tests.service.conftest import sun_at

PHOTOGRAPH = IncomingPhotograph(
    "lower", "flux", Sun(**sun_at()), taken_at=datetime(2024, 6, 1, 12, tzinfo=UTC)
)


def plain(url: URL) -> str:
    return url.render_as_string(hide_password=False).replace("+psycopg", "")
