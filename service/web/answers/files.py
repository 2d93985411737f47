"""Files as answers, by Starlette: ETag, If-None-Match, HEAD; damaged or unknown ones are never sent."""

import os
from collections.abc import Collection
from http import HTTPStatus
from pathlib import PurePath

from fastapi import HTTPException, Response
from fastapi.responses import FileResponse
from starlette.datastructures import Headers
from starlette.staticfiles import NotModifiedResponse, StaticFiles
from starlette.types import Receive, Scope, Send

# Python's own table depends on its version and on the machine's /etc/mime.types.
MEDIA_TYPES = {".css": "text/css", ".js": "text/javascript", ".svg": "image/svg+xml"}


class WholeFile(FileResponse):
    """A file as a whole: a Range, which a server may ignore, is, for Starlette answers a wrong one in plain text."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """One ASGI call."""
        headers = [(name, value) for name, value in scope["headers"] if name != b"range"]
        await super().__call__({**scope, "headers": headers}, receive, send)

    def set_stat_headers(self, stat_result: os.stat_result) -> None:
        """Length, ETag and date of the file; no more word of ranges."""
        super().set_stat_headers(stat_result)
        del self.headers["accept-ranges"]


class KnownFiles(StaticFiles):
    """The files of these names in a folder, or in packages as (package, folder), and nothing else that lies there."""

    def __init__(
        self,
        folder: os.PathLike[str],
        names: Collection[str],
        cache_control: str,
        packages: list[str | tuple[str, str]] | None = None,
    ) -> None:
        super().__init__(directory=folder, packages=packages)
        self.names = frozenset(names)
        self.cache_control = cache_control

    async def get_response(self, path: str, scope: Scope) -> Response:
        """The file, 304 where the client holds it, else 404 or 405 as a problem document."""
        if path not in self.names:
            raise HTTPException(HTTPStatus.NOT_FOUND, "there is no such file")
        return await super().get_response(path, scope)

    def file_response(
        self, full_path: str | os.PathLike[str], stat_result: os.stat_result, scope: Scope, status_code: int = 200
    ) -> Response:
        """The file with its media type, and how long it may be kept."""
        response = WholeFile(
            full_path,
            status_code,
            headers={"Cache-Control": self.cache_control},
            media_type=MEDIA_TYPES[PurePath(full_path).suffix],
            stat_result=stat_result,
        )
        if self.is_not_modified(response.headers, Headers(scope=scope)):
            return NotModifiedResponse(response.headers)
        return response


def is_held(etag: str, if_none_match: str | None) -> bool:
    """Whether a client's If-None-Match names this quoted entity tag, by the weak comparison of RFC 9110, 13.1.2."""
    tags = [tag.strip().removeprefix("W/") for tag in (if_none_match or "").split(",")]
    return etag in tags or tags == ["*"]
