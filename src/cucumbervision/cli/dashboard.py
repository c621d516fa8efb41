"""`cucumbervision dashboard`: the pages in a browser, and the password for other machines."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

__all__ = ["app", "dashboard", "set_password"]

app = typer.Typer(help="Capture, look at and forecast rounds in a browser.")


@app.callback(invoke_without_command=True)
def dashboard(
    context: typer.Context,
    store: Annotated[
        str | None,
        typer.Option(help="SQLite file or postgresql:// URL; by default one of your own."),
    ] = None,
    replay: Annotated[
        Path | None,
        typer.Option(help="Folder or recording to show where no camera is.", show_default=False),
    ] = None,
    images: Annotated[
        Path | None,
        typer.Option(help="Folder of the pictures; PostgreSQL needs one.", show_default=False),
    ] = None,
    port: Annotated[int, typer.Option(min=1, max=65535, help="Port.")] = 8501,
    address: Annotated[
        str, typer.Option(help="Address to listen on; this machine only by default.")
    ] = "127.0.0.1",
    browser: Annotated[
        bool, typer.Option("--browser/--no-browser", help="Open a browser on this machine.")
    ] = True,
    login: Annotated[
        bool,
        typer.Option(
            "--login",
            help="Ask for the login on this machine too: behind a proxy that others reach.",
        ),
    ] = False,
) -> None:
    """Capture, look at and forecast rounds in a browser. Needs the extra 'dashboard'."""
    if context.invoked_subcommand is not None:
        return
    from cucumbervision.dashboard.server import default_store, serve

    serve(
        store or default_store(),
        replay=replay,
        images=images,
        address=address,
        port=port,
        browser=browser,
        login=login,
    )


@app.command("set-password")
def set_password() -> None:
    """Set the password that viewers on other machines need; only its hash is kept."""
    from cucumbervision.dashboard.access import (
        hash_password,
        password_file,
        write_password_hash,
    )

    password = typer.prompt("Password", hide_input=True, confirmation_prompt=True)
    path = password_file()
    write_password_hash(path, hash_password(password))
    typer.echo(f"Its hash is in {path}")
