"""`cucumbervision detect`: plain pictures in, cucumbers found."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cucumbervision.cli.choices import (
    Confidence,
    Fast,
    InputSize,
    Prompt,
    Quiet,
    Runtime,
)
from cucumbervision.perception.confidence import DEFAULT_CONFIDENCE


def detect(
    inputs: Annotated[
        list[str],
        typer.Argument(
            metavar="IMAGE...",
            help="Pictures (JPEG, PNG, WebP, TIFF, BMP), folders of them, or patterns: 'a/*.jpg'.",
        ),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for results and pictures.")],
    model: Annotated[
        Path | None,
        typer.Option(help="YOLO .onnx of your own for the package's detector.", metavar="FILE"),
    ] = None,
    pose: Annotated[
        Path | None,
        typer.Option(help="YOLO pose .onnx of your own for the keypoints.", metavar="FILE"),
    ] = None,
    segmenter: Annotated[
        str,
        typer.Option(help="Network that draws the masks; none keeps the detector's."),
    ] = "mobile-sam",
    prompt: Prompt = "box+point",
    confidence: Confidence = DEFAULT_CONFIDENCE,
    overlays: Annotated[
        bool, typer.Option("--overlays/--no-overlays", help="Write annotated pictures.")
    ] = True,
    input_size: InputSize = "",
    runtime: Runtime = "auto",
    fast: Fast = False,
    quiet: Quiet = False,
) -> None:
    """Find cucumbers in plain pictures: boxes, masks and keypoints, no lengths."""
    from cucumbervision.cli.console import detect_and_show
    from cucumbervision.perception.input_sizes import parse_input_sizes
    from cucumbervision.pipeline.detect import DetectOptions

    options = DetectOptions(
        model=model,
        pose=pose,
        segmenter=segmenter,
        prompt=prompt,
        confidence=confidence,
        input_sizes=parse_input_sizes(input_size),
        runtime=runtime,
        full_precision=not fast,
        overlays=overlays,
    )
    raise typer.Exit(detect_and_show(inputs, out, options, quiet=quiet))
