"""`cucumbervision dashboard`, `serve` and `schema`: the pages, the service, its JSON Schemas."""

from __future__ import annotations

import json
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cucumbervision.cli.choices import ListenOn, Port, measure_options, takes

if TYPE_CHECKING:
    from pydantic import BaseModel

    from cucumbervision.pipeline.options import MeasureOptions


def dashboard(
    store: Annotated[
        str | None,
        typer.Option(help="SQLite file or postgresql:// URL; default: a file in your user folder."),
    ] = None,
    replay: Annotated[
        Path | None,
        typer.Option(help="Folder or recording to show instead of a camera.", show_default=False),
    ] = None,
    images: Annotated[
        Path | None,
        typer.Option(help="Folder of the pictures; required with PostgreSQL.", show_default=False),
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
            help="Require the token on this machine too, for use behind a proxy.",
        ),
    ] = False,
) -> None:
    """Capture, review and forecast rounds in a browser. Needs the extra 'dashboard'.

    Other machines need the token in the printed link, or a login by OpenID Connect.
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


@takes("options", measure_options, {"depth"})
def serve(
    address: ListenOn = "127.0.0.1",
    port: Port = 8600,
    most_mb: Annotated[
        int, typer.Option("--max-mb", min=1, help="Maximum size of a request, megabytes.")
    ] = 200,
    waiting: Annotated[int, typer.Option(min=0, help="Maximum number of waiting requests.")] = 8,
    *,
    options: MeasureOptions,
) -> None:
    """Serve POST /measure and POST /detect, /health and /metrics. Needs the extra 'serve'.

    If the environment variable CUCUMBERVISION_TOKEN is set, requests must contain this token. It is
    required for addresses that other machines can reach.
    """
    import os

    from cucumbervision.service.server import TOKEN_VARIABLE, ServiceSettings, request_limits
    from cucumbervision.service.server import serve as run

    token = os.environ.get(TOKEN_VARIABLE, "")
    settings = ServiceSettings(token, request_limits(most_mb), waiting)

    def ready() -> None:
        typer.echo(f"http://{address}:{port} (Ctrl-C ends)", err=True)

    run(options, settings, address=address, port=port, ready=ready)


class Kind(StrEnum):
    """JSON that programs read."""

    STREAM = "stream"
    MEASURE = "measure"
    DETECT = "detect"


def schema(
    kind: Annotated[
        Kind, typer.Argument(help="A line of stream; or the reply to /measure or /detect.")
    ],
) -> None:
    """Print the JSON Schema of a stream's line or a reply of the service."""
    from cucumbervision.service.work import DetectReply, MeasureReply
    from cucumbervision.streaming.stream import line_model

    models: dict[Kind, type[BaseModel]]
    models = {Kind.STREAM: line_model(), Kind.MEASURE: MeasureReply, Kind.DETECT: DetectReply}
    typer.echo(json.dumps(models[kind].model_json_schema(mode="serialization"), indent=1))
