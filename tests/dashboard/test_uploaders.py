from __future__ import annotations

import asyncio
from typing import Any

import pytest

from cucumbervision.dashboard.uploaders import UploadGuard, note_viewer


def ask(path: str, kind: str = "http") -> tuple[bool, list[dict[str, Any]]]:
    """Send a request through the guard; tell whether it went on, and what came back."""
    reached, sent = [], list[dict[str, Any]]()

    async def app(*_: object) -> None:
        reached.append(True)

    async def send(message: dict[str, Any]) -> None:
        sent.append(message)

    async def receive() -> None:
        pytest.fail("the body was read")

    asyncio.run(UploadGuard(app)({"type": kind, "path": path}, receive, send))
    return bool(reached), sent


@pytest.mark.parametrize(
    "path",
    ["/_stcore/upload_file/eve/1", "/house/_stcore/upload_file/eve/1", "/_stcore/upload_file"],
)
def test_a_stranger_sends_no_file(path: str) -> None:
    reached, sent = ask(path)
    assert not reached
    assert sent[0]["status"] == 403


def test_who_is_inside_does_until_the_session_ends() -> None:
    inside = [True]
    note_viewer("anna", lambda: inside[0])
    assert ask("/_stcore/upload_file/anna/1")[0]
    inside[0] = False
    assert not ask("/_stcore/upload_file/anna/1")[0]
    inside[0] = True
    note_viewer("anna", None)
    assert not ask("/_stcore/upload_file/anna/1")[0]


def test_all_else_goes_on() -> None:
    assert ask("/_stcore/health")[0]
    assert ask("/_stcore/stream", "websocket")[0]
