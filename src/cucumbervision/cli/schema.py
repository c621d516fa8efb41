"""`cucumbervision schema`: JSON Schemas of the stream's output and the service's replies."""

from __future__ import annotations

import json
from enum import StrEnum
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from pydantic import BaseModel


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
