"""Start the dashboard's server, and pass its options to the pages by the environment."""

from __future__ import annotations

import os
import secrets
import socket
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

from cucumbervision.access import TOKEN_VARIABLE, check_access
from cucumbervision.errors import CucumberVisionError, MissingExtraError
from cucumbervision_greenhouse.backend.settings import (
    REPLAY_VARIABLE,
    STORE_VARIABLE,
)
from cucumbervision_greenhouse.backend.theme import streamlit_options

LOGIN_VARIABLE = "CUCUMBERVISION_LOGIN"
_APP = Path(__file__).with_name("guarded_app.py")


def require_extra() -> None:
    """Raise MissingExtraError if the extra 'dashboard' is not installed."""
    if find_spec("streamlit") is None:
        raise MissingExtraError("streamlit", "dashboard")


def server_arguments(address: str, port: int, *, browser: bool) -> list[str]:
    """Return Streamlit's command line.

    Examples
    --------
    >>> "--browser.gatherUsageStats=false" in server_arguments("127.0.0.1", 8501, browser=False)
    True
    """
    options = {
        "server.address": address,
        "server.port": port,
        "server.headless": "false" if browser else "true",
        "server.showEmailPrompt": "false",
        # Besides the greeting this hides Streamlit's developer menu on the page.
        "logger.hideWelcomeMessage": "true",
        "server.fileWatcherType": "none",
        # Streamlit collects garbage after each run of a fragment, which takes 0.16 s, several times
        # a second, and blocks measuring. Python collects by itself when necessary.
        "runner.postScriptGC": "false",
        "server.maxUploadSize": 200,
        # Streamlit sends large messages, beyond this size in bytes, by their hash if they were sent
        # before; a page that has dropped one fails with "Cached ForwardMsg MISS".
        "global.minCachedMessageSize": 10**12,
        "browser.gatherUsageStats": "false",
        "browser.serverAddress": address,
        "client.toolbarMode": "minimal",
        "client.showErrorDetails": "none",
        **streamlit_options(),
    }
    return ["run", str(_APP), *(f"--{name}={value}" for name, value in options.items())]


def serve(
    store: str,
    *,
    replay: Path | None = None,
    address: str = "127.0.0.1",
    port: int = 8501,
    browser: bool = True,
    login: bool = False,
    ready: Callable[[str], None] | None = None,
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
        If the replay does not exist.
    """
    require_extra()
    from cucumbervision_greenhouse.backend.access import Login, decide_login

    how = decide_login(address, always=login)
    os.environ[LOGIN_VARIABLE] = how.value
    place = f"http://{_shown_host(address)}:{port}"
    if how is Login.TOKEN:
        token = os.environ.setdefault(TOKEN_VARIABLE, secrets.token_urlsafe(24))
        check_access(address, token)
        place += f"/?token={token}"
    if replay is not None and not replay.exists():
        raise CucumberVisionError("does not exist", source=replay, remedy="check --replay")
    variables = {STORE_VARIABLE: store, REPLAY_VARIABLE: replay}
    os.environ.update({name: str(value) for name, value in variables.items() if value})
    if ready is not None:
        ready(place)
    from streamlit.web import cli

    cli.main(server_arguments(address, port, browser=browser), standalone_mode=False)


def _shown_host(address: str) -> str:
    """Return the address to open in a browser; for all interfaces, this machine's name."""
    if address in ("", "0.0.0.0", "::"):
        return socket.gethostname()
    return f"[{address}]" if ":" in address else address
