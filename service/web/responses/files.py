"""Files as responses by Starlette, with ETag, If-None-Match and HEAD."""

import os
from collections.abc import Collection
from http import HTTPStatus
from pathlib import PurePath

from fastapi import HTTPException, Response
from fastapi.responses import FileResponse
from starlette.datastructures import Headers
from starlette.staticfiles import NotModifiedResponse, StaticFiles
from starlette.types import Receive, Scope, Send

# Fixed, because the table of Python depends on its version and on /etc/mime.types.
MEDIA_TYPES = {".css": "text/css", ".js": "text/javascript", ".svg": "image/svg+xml"}


class WholeFile(FileResponse):
    """A complete file, which ignores Range headers.

    A server may ignore Range. Starlette would answer a wrong Range in plain text.
    """

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """One ASGI call."""
        headers = [(name, value) for name, value in scope["headers"] if name != b"range"]
        await super().__call__({**scope, "headers": headers}, receive, send)

    def set_stat_headers(self, stat_result: os.stat_result) -> None:
        """Set length, ETag and date of the file, and remove the header that offers ranges."""
        super().set_stat_headers(stat_result)
        del self.headers["accept-ranges"]


class KnownFiles(StaticFiles):
    """The files with these names in a folder, or in packages as (package, folder).

    Other files of the folder are not served.
    """

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
        """The file, 304 if the client has it, or a problem (404 or 405)."""
        if path not in self.names:
            raise HTTPException(HTTPStatus.NOT_FOUND, "there is no such file")
        return await super().get_response(path, scope)

    def file_response(
        self,
        full_path: str | os.PathLike[str],
        stat_result: os.stat_result,
        scope: Scope,
        status_code: int = 200,
    ) -> Response:
        """The file with its media type and Cache-Control."""
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


def etag_matches(etag: str, if_none_match: str | None) -> bool:
    """Whether the If-None-Match of a client names this quoted entity tag.

    Weak comparison of RFC 9110, section 13.1.2.
    """
    tags = [tag.strip().removeprefix("W/") for tag in (if_none_match or "").split(",")]
    return etag in tags or tags == ["*"]
