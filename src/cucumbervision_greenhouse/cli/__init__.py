"""Commands of the greenhouse, registered through an entry point."""

from __future__ import annotations

import os
import secrets
import socket
import threading
import webbrowser
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import typer

from cucumbervision.cli.choices import ListenOn, Port
from cucumbervision.errors import CucumberVisionError, MissingExtraError

__all__ = ["register"]

_BROWSER_S = 1.0  # until the server listens


def register(program: typer.Typer, groups: Mapping[str, typer.Typer]) -> None:  # noqa: ARG001
    """Register the greenhouse's commands.

    Parameters
    ----------
    program : typer.Typer
        The command `cucumbervision`.
    groups : mapping of str to typer.Typer
        Its command groups.
    """
    from cucumbervision_greenhouse.cli import round

    program.command()(dashboard)
    program.command()(round.export)
    program.add_typer(round.app, name="round")


def dashboard(
    store: Annotated[
        str | None,
        typer.Option(
            help="SQLite file or postgresql://…?images=FOLDER; default: a file in your user folder."
        ),
    ] = None,
    replay: Annotated[
        Path | None,
        typer.Option(help="Folder or recording to show instead of a camera.", show_default=False),
    ] = None,
    port: Port = 8501,
    address: ListenOn = "127.0.0.1",
    browser: Annotated[
        bool, typer.Option("--browser/--no-browser", help="Open a browser on this machine.")
    ] = True,
    login: Annotated[
        bool,
        typer.Option(
            "--login", help="Require the token on this machine too, for use behind a proxy."
        ),
    ] = False,
) -> None:
    """Capture, review and forecast rounds in a browser. Needs the extra 'dashboard'.

    Other machines need the token in the printed link, or a proxy that logs people in.
    """
    if find_spec("streamlit") is None:
        raise MissingExtraError("streamlit", "dashboard")
    from cucumbervision.access import TOKEN_VARIABLE, check_access
    from cucumbervision.service.requests import listen
    from cucumbervision_greenhouse import settings
    from cucumbervision_greenhouse.access import Login, decide_login
    from cucumbervision_greenhouse.routes import guarded_app

    if replay is not None and not replay.exists():
        raise CucumberVisionError("does not exist", source=replay, remedy="check the path")
    how = decide_login(address, always=login)
    # Pages get their options by the environment.
    os.environ[settings.LOGIN_VARIABLE] = how.value
    os.environ[settings.STORE_VARIABLE] = store or settings.default_store()
    if replay is not None:
        os.environ[settings.REPLAY_VARIABLE] = str(replay)
    place = f"http://{_shown_host(address)}:{port}"
    if how is Login.TOKEN:
        token = os.environ.setdefault(TOKEN_VARIABLE, secrets.token_urlsafe(24))
        check_access(address, token)
        place += f"/?token={token}"

    def bound() -> None:
        typer.echo(f"{place} (Ctrl-C ends)", err=True)
        if browser:
            threading.Timer(_BROWSER_S, webbrowser.open, [place]).start()

    listen(guarded_app(how), address, port, sockets="websockets-sansio", ready=bound)


def _shown_host(address: str) -> str:
    """Return the address to open in a browser; for all interfaces, this machine's name."""
    if address in ("", "0.0.0.0", "::"):
        return socket.gethostname()
    return f"[{address}]" if ":" in address else address
