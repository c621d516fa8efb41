"""Commands of the greenhouse, registered through an entry point."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cucumbervision.cli.choices import ListenOn, Port

if TYPE_CHECKING:
    from collections.abc import Mapping

__all__ = ["register"]


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
