"""Options that several commands share, and exit codes. Nothing slow is imported for them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, TypeAlias

import typer

from cucumbervision.measurement.result import LengthDefinition

EXIT_CODES = (
    "Exit codes: 0 everything was read and written, even if a fruit could not be measured; 1 "
    "something failed (see failures.csv), the rest was done; 2 nothing could be done; 70 a defect "
    "of the software was met, the rest was done; 130 interrupted."
)
"""What commands that work through many captures exit with; shown by their --help."""

SegmenterChoice: TypeAlias = Literal["mobile-sam", "sam-vit-b", "none"]
PromptChoice: TypeAlias = Literal["box+point", "box", "point"]
RuntimeChoice: TypeAlias = Literal["auto", "onnxruntime", "openvino", "cuda", "tensorrt"]

Instances = Annotated[
    str,
    typer.Option(
        help="Where fruit come from: models (the package's own), dataset (its own masks), or a "
        "FILE: COCO JSON, YOLO txt, YOLO .onnx. auto: the data set's masks, else models."
    ),
]
Segmenter = Annotated[
    SegmenterChoice | None,
    typer.Option(help="Who draws the masks; given, it also redraws a data set's own."),
]
Prompt = Annotated[PromptChoice, typer.Option(help="What SAM is shown.")]
Confidence = Annotated[
    float, typer.Option(min=0.0, max=1.0, help="Least confidence of a detection.")
]
InputSize = Annotated[
    str,
    typer.Option(
        help="Long side of what the networks see, pixels: a multiple of 32, or several joined by "
        "commas, whose finds are merged. Without it each network's own.",
        metavar="PX[,PX]",
    ),
]
Runtime = Annotated[RuntimeChoice, typer.Option(help="What runs the networks.")]
Fast = Annotated[
    bool,
    typer.Option(
        "--fast",
        help="Let networks compute in half precision where the processor can: quicker, but "
        "outlines and lengths may differ a little from machine to machine.",
    ),
]
Length = Annotated[
    LengthDefinition, typer.Option(help="Which length, where a tube could be fitted.")
]
Crop = Annotated[
    str, typer.Option("--profile", help="Crop profile: a length that it does not accept is none.")
]
Calibration = Annotated[
    Path | None, typer.Option(help="Site's calibration, from `cucumbervision calibrate`.")
]
Intrinsics = Annotated[Path | None, typer.Option(help="Camera file (JSON) of the colour stream.")]
Burst = Annotated[
    int, typer.Option(min=1, max=99, help="Frames of a recording or camera fused to one capture.")
]

Serial = Annotated[
    str | None, typer.Option(help="The camera's serial number; the first one found without it.")
]
Fps = Annotated[int, typer.Option(min=1, max=90, help="The camera's frames a second.")]
Retries = Annotated[
    int, typer.Option(min=0, help="How often a camera that is gone is opened again.")
]

ListenOn = Annotated[
    str, typer.Option("--address", help="Address to listen on; this machine only by default.")
]
Port = Annotated[int, typer.Option(min=1, max=65535, help="Port.")]

Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but errors.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print the rows as JSON instead of a table.")]
StoreName = Annotated[
    str,
    typer.Option(
        "--store", envvar="CUCUMBERVISION_STORE", help="SQLite file, or postgresql://… address."
    ),
]
Images = Annotated[
    Path | None, typer.Option(help="Folder of the pictures; needed with PostgreSQL.")
]
RoundName = Annotated[
    str, typer.Option("--round", "-r", help="Name, key or start of a key; the newest without.")
]
Profile = Annotated[
    str | None, typer.Option(help="Crop profile for classes; by default the round's own.")
]
