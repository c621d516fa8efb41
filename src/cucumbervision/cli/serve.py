"""`cucumbervision serve`: captures in and rows out over HTTP."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from cucumbervision.cli.choices import ListenOn, Port, takes_measure_options

if TYPE_CHECKING:
    from cucumbervision.pipeline.options import MeasureOptions


@takes_measure_options("depth")
def serve(
    address: ListenOn = "127.0.0.1",
    port: Port = 8600,
    token: Annotated[
        str,
        typer.Option(
            envvar="CUCUMBERVISION_TOKEN",
            help="What requests must carry; needed for addresses that other machines reach. "
            "Better in the environment than on the command line, where others see it.",
            show_default=False,
        ),
    ] = "",
    most_mb: Annotated[
        int, typer.Option("--max-mb", min=1, help="Largest request, megabytes.")
    ] = 200,
    waiting: Annotated[
        int, typer.Option(min=0, help="Requests that may wait for the one that is measured.")
    ] = 8,
    *,
    options: MeasureOptions,
) -> None:
    """Serve POST /measure and POST /detect, /health and /metrics. Needs the extra 'serve'."""
    from cucumbervision.service.server import ServiceSettings, request_limits
    from cucumbervision.service.server import serve as run

    settings = ServiceSettings(token, request_limits(most_mb), waiting)

    def ready() -> None:
        typer.echo(f"http://{address}:{port} (Ctrl-C ends)", err=True)

    run(options, settings, address=address, port=port, ready=ready)
