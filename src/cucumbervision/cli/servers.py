"""`cucumbervision serve` and `schema`: the service, and the JSON Schemas."""

from __future__ import annotations

import json
from enum import StrEnum
from typing import TYPE_CHECKING, Annotated

import typer

from cucumbervision.cli.choices import OF_CAMERA_FILE, ListenOn, Port, measure_options, takes

if TYPE_CHECKING:
    from pydantic import BaseModel

    from cucumbervision.pipeline.options import MeasureOptions


@takes("options", measure_options, {"depth"} | OF_CAMERA_FILE)
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
    from cucumbervision.service.server import serve as run

    def ready() -> None:
        typer.echo(f"http://{address}:{port} (Ctrl-C ends)", err=True)

    run(options, address=address, port=port, most_mb=most_mb, waiting=waiting, ready=ready)


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
    from cucumbervision.service.app import DetectReply, MeasureReply
    from cucumbervision.streaming.stream import line_model

    models: dict[Kind, type[BaseModel]]
    models = {Kind.STREAM: line_model(), Kind.MEASURE: MeasureReply, Kind.DETECT: DetectReply}
    typer.echo(json.dumps(models[kind].model_json_schema(mode="serialization"), indent=1))
