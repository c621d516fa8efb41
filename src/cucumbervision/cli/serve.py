"""`cucumbervision serve`: captures in and rows out over HTTP."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from cucumbervision.cli.choices import ListenOn, Port, measure_options, takes

if TYPE_CHECKING:
    from cucumbervision.pipeline.options import MeasureOptions


@takes("options", measure_options, {"depth"})
def serve(
    address: ListenOn = "127.0.0.1",
    port: Port = 8600,
    most_mb: Annotated[
        int, typer.Option("--max-mb", min=1, help="Largest request, megabytes.")
    ] = 200,
    waiting: Annotated[
        int, typer.Option(min=0, help="Requests that may wait for the one that is measured.")
    ] = 8,
    *,
    options: MeasureOptions,
) -> None:
    """Serve POST /measure and POST /detect, /health and /metrics. Needs the extra 'serve'.

    Requests must carry the token in the environment's CUCUMBERVISION_TOKEN, where there is one;
    addresses that other machines reach need it.
    """
    import os

    from cucumbervision.service.server import TOKEN_VARIABLE, ServiceSettings, request_limits
    from cucumbervision.service.server import serve as run

    token = os.environ.get(TOKEN_VARIABLE, "")
    settings = ServiceSettings(token, request_limits(most_mb), waiting)

    def ready() -> None:
        typer.echo(f"http://{address}:{port} (Ctrl-C ends)", err=True)

    run(options, settings, address=address, port=port, ready=ready)
