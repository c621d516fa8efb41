"""`cucumbervision dashboard`: the pages of a greenhouse."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cucumbervision.cli.choices import ListenOn, Port


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
    from cucumbervision_greenhouse.server import serve
    from cucumbervision_greenhouse.settings import default_store

    serve(
        store or default_store(),
        replay=replay,
        address=address,
        port=port,
        browser=browser,
        login=login,
        ready=lambda place: typer.echo(f"{place} (Ctrl-C ends)", err=True),
    )
