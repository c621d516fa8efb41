"""Start the dashboard's server: on this machine only, without telemetry."""

from __future__ import annotations

import ipaddress
import os
from importlib.util import find_spec
from pathlib import Path

from cucumbervision.errors import CucumberVisionError, MissingExtraError

__all__ = ["is_local", "serve", "server_arguments"]

APP = Path(__file__).with_name("app.py")


def is_local(address: str) -> bool:
    """Say whether only this machine can reach an address.

    Examples
    --------
    >>> is_local("127.0.0.1"), is_local("localhost"), is_local("0.0.0.0"), is_local("10.0.0.7")
    (True, True, False, False)
    """
    if address == "localhost":
        return True
    try:
        return ipaddress.ip_address(address).is_loopback
    except ValueError:
        return False


def server_arguments(address: str, port: int, *, browser: bool) -> list[str]:
    """Give Streamlit's command line.

    Examples
    --------
    >>> "--browser.gatherUsageStats=false" in server_arguments("127.0.0.1", 8501, browser=False)
    True
    """
    said = {
        "server.address": address,
        "server.port": port,
        "server.headless": "false" if browser else "true",
        "server.showEmailPrompt": "false",
        "server.fileWatcherType": "none",
        "server.maxUploadSize": 200,
        "browser.gatherUsageStats": "false",
        "browser.serverAddress": address,
        "client.toolbarMode": "minimal",
        "client.showErrorDetails": "none",
        "theme.primaryColor": "#1B7837",
        "theme.baseFontSize": 17,
    }
    return ["run", str(APP), *(f"--{name}={value}" for name, value in said.items())]


def serve(
    store: str,
    *,
    replay: Path | None = None,
    images: Path | None = None,
    address: str = "127.0.0.1",
    port: int = 8501,
    browser: bool = True,
) -> None:
    """Serve the dashboard until it is interrupted.

    Parameters
    ----------
    store : str
        Path of an SQLite file, or the URL of a PostgreSQL database.
    replay : Path, optional
        Folder or recording that is shown where no camera is; the bundled captures by default.
    images : Path, optional
        Folder of the pictures, which PostgreSQL needs.
    address : str
        What to listen on.
    port : int
        TCP port.
    browser : bool
        Open a browser on this machine.

    Raises
    ------
    MissingExtraError
        If Streamlit is not installed.
    CucumberVisionError
        If the address can be reached from other machines: that needs a login.
    """
    from cucumbervision.dashboard.variables import (
        IMAGES_VARIABLE,
        REPLAY_VARIABLE,
        STORE_VARIABLE,
    )

    if find_spec("streamlit") is None:
        raise MissingExtraError("streamlit", "dashboard")
    if not is_local(address):
        raise CucumberVisionError(
            "others could reach this address, and the dashboard has no login",
            source=f"--address {address}",
            remedy="leave --address out, and reach it from elsewhere through SSH or a proxy "
            "with a login",
        )
    if replay is not None and not replay.exists():
        raise CucumberVisionError("does not exist", source=replay, remedy="check --replay")
    given = {STORE_VARIABLE: store, REPLAY_VARIABLE: replay, IMAGES_VARIABLE: images}
    os.environ.update({name: str(value) for name, value in given.items() if value})
    from streamlit.web import cli

    cli.main(server_arguments(address, port, browser=browser), standalone_mode=False)
