"""`cucumbervision measure`: RGB-D captures in, lengths out."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cucumbervision.cli.choices import (
    INPUT_SIZE,
    PromptChoice,
    RuntimeChoice,
    SegmenterChoice,
)
from cucumbervision.measurement.result import LengthDefinition, Selector

__all__ = ["measure"]


def measure(
    inputs: Annotated[
        list[Path],
        typer.Argument(
            metavar="INPUT...",
            help="Capture folders, BOP scenes, colour + depth pairs, Viewer exports, .bag or .db3.",
        ),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for tables and pictures.")],
    instances: Annotated[
        str,
        typer.Option(
            help="Where fruit come from: models (the package's own), dataset (its own masks), or a "
            "FILE: COCO JSON, YOLO txt, YOLO .onnx. auto: the data set's masks, else models."
        ),
    ] = "auto",
    pose: Annotated[
        Path | None, typer.Option(help="YOLO pose .onnx of your own for the keypoints of M4.")
    ] = None,
    methods: Annotated[str, typer.Option(help="all, or some of m1,m2,m3,m4,m5,m6.")] = "all",
    selector: Annotated[Selector, typer.Option(help="How one method is chosen.")] = Selector.BEST,
    length: Annotated[
        LengthDefinition, typer.Option(help="Which length, where a tube could be fitted.")
    ] = LengthDefinition.THREAD,
    segmenter: Annotated[
        SegmenterChoice | None,
        typer.Option(help="Who draws the masks; given, it also redraws a data set's own."),
    ] = None,
    prompt: Annotated[PromptChoice, typer.Option(help="What SAM is shown.")] = PromptChoice.both,
    confidence: Annotated[
        float, typer.Option(min=0.0, max=1.0, help="Least confidence of a detection.")
    ] = 0.30,
    intrinsics: Annotated[
        Path | None, typer.Option(help="Camera file (JSON) of the colour stream.")
    ] = None,
    depth: Annotated[
        Path | None, typer.Option(help="Depth picture, where INPUT is a colour picture.")
    ] = None,
    depth_unit: Annotated[
        float | None, typer.Option(min=1e-6, help="Metres of one depth step, such as 0.001.")
    ] = None,
    burst: Annotated[
        int, typer.Option(min=1, max=99, help="Frames of a recording fused to one capture.")
    ] = 5,
    calibration: Annotated[
        Path | None, typer.Option(help="Site's calibration, from `cucumbervision calibrate`.")
    ] = None,
    input_size: Annotated[str, typer.Option(help=INPUT_SIZE, metavar="PX[,PX]")] = "",
    runtime: Annotated[
        RuntimeChoice, typer.Option(help="What runs the networks.")
    ] = RuntimeChoice.auto,
    fast: Annotated[
        bool,
        typer.Option(
            "--fast",
            help="Let networks compute in half precision where the processor can: quicker, but "
            "lengths may differ a little from machine to machine.",
        ),
    ] = False,
    guard: Annotated[
        bool,
        typer.Option(
            "--guard", help="Play recordings from untrusted senders in a separate, limited process."
        ),
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but errors.")] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the rows as JSON instead of a table.")
    ] = False,
) -> None:
    """Measure every fruit of every capture, by M1 to M6, and choose the best for each."""
    from cucumbervision.capture.source import ReadOptions
    from cucumbervision.cli.console import run_and_show
    from cucumbervision.perception.yolo import parse_input_sizes
    from cucumbervision.pipeline.options import MeasureOptions, parse_methods

    options = MeasureOptions(
        instances=instances,
        pose=pose,
        segmenter=None if segmenter is None else segmenter.value,
        prompt=prompt.value,
        methods=parse_methods(methods),
        selector=selector,
        length=length,
        confidence=confidence,
        input_sizes=parse_input_sizes(input_size),
        runtime=runtime.value,
        full_precision=not fast,
        reading=ReadOptions(intrinsics, depth, depth_unit, burst),
        calibration=calibration,
    )
    raise typer.Exit(run_and_show(inputs, out, options, quiet=quiet, as_json=as_json, guard=guard))
