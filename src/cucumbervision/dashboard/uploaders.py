"""Who may upload: a request that sends a file is let in only from a page of a viewer who is inside.

Streamlit's own route takes a file from every session, and anyone who opens a page has one.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, MutableMapping

_UPLOAD = re.compile(r"/_stcore/upload_file/([^/]+)/")
_MOST = 10_000  # sessions that are remembered

_inside: dict[str, Callable[[], bool]] = {}


def note_viewer(session: str, holds: Callable[[], bool] | None) -> None:
    """Note who is behind a page.

    Parameters
    ----------
    session : str
        Streamlit's identifier of the page's session.
    holds : callable, optional
        Whether the viewer is still inside, asked at each upload; None for one who is not.
    """
    _inside.pop(session, None)
    if holds is not None:
        _inside[session] = holds
    while len(_inside) > _MOST:
        del _inside[next(iter(_inside))]


def _may_upload(path: str) -> bool:
    """Return whether a request may go on: it uploads nothing, or its viewer is inside.

    Examples
    --------
    >>> note_viewer("a", lambda: True)
    >>> paths = ("/_stcore/health", "/_stcore/upload_file/a/1", "/_stcore/upload_file/b/1")
    >>> [_may_upload(path) for path in paths]
    [True, True, False]
    """
    found = _UPLOAD.search(path)
    if found is None:
        return "/_stcore/upload_file" not in path
    holds = _inside.get(found.group(1))
    return holds is not None and holds()


class UploadGuard:
    """ASGI middleware: answers uploads of strangers with 403 before a byte of them is read."""

    def __init__(self, app: Callable[..., Awaitable[None]]) -> None:
        self._app = app

    async def __call__(
        self, scope: MutableMapping[str, Any], receive: Callable[..., Any], send: Callable[..., Any]
    ) -> None:
        """Pass a request on, or refuse it."""
        if scope["type"] != "http" or _may_upload(scope["path"]):
            await self._app(scope, receive, send)
            return
        head = [(b"content-type", b"text/plain"), (b"connection", b"close")]
        await send({"type": "http.response.start", "status": 403, "headers": head})
        await send({"type": "http.response.body", "body": b"log in first"})
