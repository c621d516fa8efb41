"""`cucumbervision evaluate models` and `photos`: the networks against labelled pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cucumbervision.cli.choices import InputSize, Runtime
from cucumbervision.perception.confidence import DEFAULT_CONFIDENCE

Seg = Annotated[
    Path | None, typer.Option(help="YOLO .onnx that boxes and masks; else the package's own.")
]
Pose = Annotated[Path | None, typer.Option(help="YOLO pose .onnx; else the package's own.")]
Confidence = Annotated[
    float, typer.Option(min=0.0, max=1.0, help="At which recall and precision are judged.")
]


def evaluate_models(
    data: Annotated[
        Path,
        typer.Argument(help="Labelled pictures: a folder with annotations.json, or COCO JSON."),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the figures.")],
    seg: Seg = None,
    pose: Pose = None,
    segmenter: Annotated[
        str, typer.Option(help="Network that draws the masks; none keeps the detector's.")
    ] = "mobile-sam",
    runtime: Runtime = "auto",
    confidence: Confidence = DEFAULT_CONFIDENCE,
    input_size: InputSize = "",
    split: Annotated[str, typer.Option(help="test, val, train or all.")] = "test",
    limit: Annotated[
        int | None, typer.Option(min=1, help="Pictures at most, evenly spread.")
    ] = None,
    sam_limit: Annotated[
        int, typer.Option(min=1, help="Pictures at most for SAM and lengths, evenly spread.")
    ] = 40,
) -> None:
    """Compare the networks with labelled pictures: precision, recall, keypoints, masks, lengths."""
    from cucumbervision.perception.input_sizes import parse_input_sizes
    from cucumbervision_lab.cli.screen import part_bars, show, show_tables
    from cucumbervision_lab.detection.report import (
        detection_tables,
        summarise,
        write_detection_report,
    )
    from cucumbervision_lab.detection.run import DetectionOptions, evaluate_detection

    plan = DetectionOptions(
        data,
        seg,
        pose,
        None if segmenter == "none" else segmenter,
        runtime,
        confidence,
        split,
        limit,
        sam_limit,
        parse_input_sizes(input_size),
    )
    with part_bars() as report:
        result = evaluate_detection(plan, report)
    summary = summarise(result)
    tables = detection_tables(summary, plan.confidence)
    show_tables(tables)
    show(f"The figures are in {write_detection_report(result, summary, tables, out)}")


def evaluate_photos(
    folder: Annotated[
        Path, typer.Argument(help="Folder of the audited real photos, searched with subfolders.")
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the figures.")],
    seg: Seg = None,
    pose: Pose = None,
    runtime: Runtime = "auto",
    confidence: Confidence = DEFAULT_CONFIDENCE,
    input_size: InputSize = "",
    split: Annotated[str, typer.Option(help="test, val or train.")] = "test",
) -> None:
    """Compare the networks with audited real photos: recall and precision, each test apart."""
    from cucumbervision.perception.input_sizes import parse_input_sizes
    from cucumbervision_lab.cli.screen import part_bars, show, show_tables
    from cucumbervision_lab.detection.report import photo_tables, write_photo_report
    from cucumbervision_lab.detection.run import evaluate_real_photos

    with part_bars() as report:
        result = evaluate_real_photos(
            folder,
            seg,
            pose,
            runtime=runtime,
            confidence=confidence,
            split=split,
            input_sizes=parse_input_sizes(input_size),
            report=report,
        )
    tables = photo_tables(result)
    show_tables(tables)
    show(f"The figures are in {write_photo_report(result, tables, out)}")
