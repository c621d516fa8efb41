"""Start the dashboard's server, and pass its options to the pages by the environment."""

from __future__ import annotations

import os
import secrets
import socket
import threading
import webbrowser
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

from cucumbervision.access import TOKEN_VARIABLE, check_access
from cucumbervision.errors import CucumberVisionError, MissingExtraError
from cucumbervision_greenhouse.settings import LOGIN_VARIABLE, REPLAY_VARIABLE, STORE_VARIABLE

_BROWSER_S = 1.0  # until the server listens


def require_extra() -> None:
    """Raise MissingExtraError if the extra 'dashboard' is not installed."""
    if find_spec("streamlit") is None:
        raise MissingExtraError("streamlit", "dashboard")


def serve(
    store: str,
    *,
    replay: Path | None = None,
    address: str = "127.0.0.1",
    port: int = 8501,
    browser: bool = True,
    login: bool = False,
    ready: Callable[[str], None] = lambda _: None,
) -> None:
    """Serve the dashboard until it is interrupted.

    Parameters
    ----------
    store : str
        Path of an SQLite file, or 'postgresql://user@host/database?images=FOLDER'.
    replay : Path, optional
        Folder or recording to show without a camera; the bundled captures by default.
    address : str
        Address to bind to.
    port : int
        TCP port.
    browser : bool
        Open a browser on this machine.
    login : bool
        Require a login on this machine too, for a proxy that serves others.
    ready : callable, optional
        Called with the address to open, which contains the token where one is needed.

    Raises
    ------
    MissingExtraError
        If the extra 'dashboard' is not installed.
    AccessError
        If the token in the environment is too short.
    CucumberVisionError
        If the replay does not exist, or the port is taken.
    """
    require_extra()
    from cucumbervision_greenhouse.access import Login, decide_login

    how = decide_login(address, always=login)
    os.environ[LOGIN_VARIABLE] = how.value
    place = f"http://{_shown_host(address)}:{port}"
    if how is Login.TOKEN:
        token = os.environ.setdefault(TOKEN_VARIABLE, secrets.token_urlsafe(24))
        check_access(address, token)
        place += f"/?token={token}"
    if replay is not None and not replay.exists():
        raise CucumberVisionError("does not exist", source=replay, remedy="check the path")
    os.environ |= {STORE_VARIABLE: store, **({REPLAY_VARIABLE: str(replay)} if replay else {})}
    from cucumbervision.service.requests import listen
    from cucumbervision_greenhouse.routes import guarded_app

    def bound() -> None:
        ready(place)
        if browser:
            threading.Timer(_BROWSER_S, webbrowser.open, [place]).start()

    listen(guarded_app(how), address, port, sockets="websockets-sansio", ready=bound)


def _shown_host(address: str) -> str:
    """Return the address to open in a browser; for all interfaces, this machine's name."""
    if address in ("", "0.0.0.0", "::"):
        return socket.gethostname()
    return f"[{address}]" if ":" in address else address
