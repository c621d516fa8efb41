"""Options that several commands share, and exit codes. Nothing slow is imported for them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, TypeAlias

import typer

__all__ = [
    "EXIT_CODES",
    "AsJson",
    "Calibration",
    "Confidence",
    "Images",
    "InputSize",
    "Prompt",
    "PromptChoice",
    "Quiet",
    "RoundName",
    "Runtime",
    "RuntimeChoice",
    "SegmenterChoice",
    "StoreName",
]

EXIT_CODES = (
    "Exit codes: 0 everything was read and written, even if a fruit could not be measured; 1 "
    "something failed (see failures.csv), the rest was done; 2 nothing could be done; 70 a defect "
    "of the software was met, the rest was done; 130 interrupted."
)
"""What commands that work through many captures exit with; shown by their --help."""

SegmenterChoice: TypeAlias = Literal["mobile-sam", "sam-vit-b", "none"]
PromptChoice: TypeAlias = Literal["box+point", "box", "point"]
RuntimeChoice: TypeAlias = Literal["auto", "onnxruntime", "openvino", "cuda", "tensorrt"]

Prompt = Annotated[PromptChoice, typer.Option(help="What SAM is shown.")]
Runtime = Annotated[RuntimeChoice, typer.Option(help="What runs the networks.")]
Confidence = Annotated[
    float, typer.Option(min=0.0, max=1.0, help="Least confidence of a detection.")
]
Calibration = Annotated[
    Path | None, typer.Option(help="Site's calibration, from `cucumbervision calibrate`.")
]
InputSize = Annotated[
    str,
    typer.Option(
        help="Long side of what the networks see, pixels: a multiple of 32, or several joined by "
        "commas, whose finds are merged. Without it each network's own.",
        metavar="PX[,PX]",
    ),
]
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
