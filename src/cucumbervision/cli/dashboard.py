"""`cucumbervision dashboard`: the pages in a browser,."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cucumbervision.cli.choices import ListenOn, Port


def dashboard(
    store: Annotated[
        str | None,
        typer.Option(help="SQLite file or postgresql:// URL; your own file by default."),
    ] = None,
    replay: Annotated[
        Path | None,
        typer.Option(help="Folder or recording to show where no camera is.", show_default=False),
    ] = None,
    images: Annotated[
        Path | None,
        typer.Option(help="Folder of the pictures; PostgreSQL needs one.", show_default=False),
    ] = None,
    port: Port = 8501,
    address: ListenOn = "127.0.0.1",
    browser: Annotated[
        bool, typer.Option("--browser/--no-browser", help="Open a browser on this machine.")
    ] = True,
    login: Annotated[
        bool,
        typer.Option(
            "--login",
            help="Require the token on this machine too: behind a proxy that others reach.",
        ),
    ] = False,
) -> None:
    """Capture, look at and forecast rounds in a browser. Needs the extra 'dashboard'.

    Other machines need the token in the link that is printed, or a login by OpenID Connect.
    """
    from cucumbervision.dashboard.server import default_store, serve

    serve(
        store or default_store(),
        replay=replay,
        images=images,
        address=address,
        port=port,
        browser=browser,
        login=login,
        ready=lambda place: typer.echo(f"{place} (Ctrl-C ends)", err=True),
    )
