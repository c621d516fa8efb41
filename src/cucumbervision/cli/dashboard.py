"""`cucumbervision dashboard`: the pages in a browser, and accounts for other machines."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cucumbervision.cli.choices import ListenOn, Port

app = typer.Typer(help="Capture, look at and forecast rounds in a browser.")


@app.callback(invoke_without_command=True)
def dashboard(
    context: typer.Context,
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
            help="Require a login on this machine too: behind a proxy that others reach.",
        ),
    ] = False,
) -> None:
    """Capture, look at and forecast rounds in a browser. Needs the extra 'dashboard'."""
    if context.invoked_subcommand is not None:
        return
    from cucumbervision.dashboard.server import default_store, serve

    typer.echo(f"The dashboard comes up at http://{address}:{port}; Ctrl-C ends it.", err=True)
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
def set_password(
    account: Annotated[str, typer.Argument(help="Name of the account.", metavar="ACCOUNT")],
) -> None:
    """Set an account's password for viewers on other machines; only its argon2 hash is stored."""
    from cucumbervision.dashboard.server import require_extra

    require_extra()
    from cucumbervision.dashboard import access

    password = typer.prompt("Password", hide_input=True, confirmation_prompt=True)
    path = access.accounts_file()
    access.set_password(path, account, password)
    typer.echo(f"The accounts are in {path}; to remove one, delete its line")
