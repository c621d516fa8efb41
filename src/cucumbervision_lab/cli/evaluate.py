"""`cucumbervision benchmark`, and `evaluate models` and `photos`: the methods and the networks."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cucumbervision.cli.choices import InputSize, Runtime
from cucumbervision.networks import DEFAULT_CONFIDENCE
from cucumbervision_lab.cli.screen import part_bars, show, show_tables, ticking

Seg = Annotated[
    Path | None, typer.Option(help="YOLO segmentation .onnx; default: the packaged network.")
]
Pose = Annotated[Path | None, typer.Option(help="YOLO pose .onnx; default: the packaged network.")]
Confidence = Annotated[
    float, typer.Option(min=0.0, max=1.0, help="Confidence threshold for recall and precision.")
]


def evaluate_models(
    data: Annotated[
        Path, typer.Argument(help="Labelled pictures: folder with annotations.json, or COCO JSON.")
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the results.")],
    seg: Seg = None,
    pose: Pose = None,
    segmenter: Annotated[
        str, typer.Option(help="Segmenter for the masks; none keeps the detector's masks.")
    ] = "mobile-sam",
    runtime: Runtime = "auto",
    confidence: Confidence = DEFAULT_CONFIDENCE,
    input_size: InputSize = "",
    split: Annotated[str, typer.Option(help="Split: test, val, train or all.")] = "test",
    limit: Annotated[
        int | None, typer.Option(min=1, help="Maximum number of pictures, evenly spaced.")
    ] = None,
    sam_limit: Annotated[
        int, typer.Option(min=1, help="Maximum number of pictures for SAM and lengths.")
    ] = 40,
) -> None:
    """Evaluate the networks on labelled pictures: precision, recall, keypoints, masks, lengths."""
    from cucumbervision.networks.yolo import parse_input_sizes
    from cucumbervision_lab.evaluate.report import detection_tables, write_detection_report
    from cucumbervision_lab.evaluate.scenes import evaluate_detection

    with part_bars() as report:
        result = evaluate_detection(
            data,
            seg,
            pose,
            segmenter=None if segmenter == "none" else segmenter,
            runtime=runtime,
            confidence=confidence,
            split=split,
            limit=limit,
            sam_limit=sam_limit,
            input_sizes=parse_input_sizes(input_size),
            report=report,
        )
    tables = detection_tables(result)
    show_tables(tables)
    show(f"Results: {write_detection_report(result, tables, out)}")


def evaluate_photos(
    folder: Annotated[
        Path, typer.Argument(help="Folder of the audited photos, searched recursively.")
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the results.")],
    seg: Seg = None,
    pose: Pose = None,
    runtime: Runtime = "auto",
    confidence: Confidence = DEFAULT_CONFIDENCE,
    input_size: InputSize = "",
    split: Annotated[str, typer.Option(help="Split: test, val or train.")] = "test",
) -> None:
    """Evaluate the networks on audited real photos: recall and precision by test."""
    from cucumbervision.networks.yolo import parse_input_sizes
    from cucumbervision_lab.evaluate.photos import audited_photos
    from cucumbervision_lab.evaluate.photos import evaluate_photos as evaluate
    from cucumbervision_lab.evaluate.pictures import open_networks
    from cucumbervision_lab.evaluate.report import photo_tables, write_photo_report

    photos, missing = audited_photos(folder, split)
    networks = open_networks(
        seg,
        pose,
        "mobile-sam",
        runtime=runtime,
        confidence=confidence,
        ranked=False,
        input_sizes=parse_input_sizes(input_size),
    )
    with ticking("photos", len(photos.pictures)) as tick:
        result = evaluate(photos, networks, missing, tick)
    tables = photo_tables(result)
    show_tables(tables)
    show(f"Results: {write_photo_report(result, tables, out)}")


def benchmark(
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Folder for records and results; rerun to resume.")
    ] = Path("benchmark"),
    quick: Annotated[
        bool,
        typer.Option("--quick", help="Run a few captures without networks, in about a minute."),
    ] = False,
    stress: Annotated[int, typer.Option(min=0, help="Number of fruit in the stress set.")] = 2000,
    workers: Annotated[int, typer.Option(min=1, help="Number of processes.")] = 2,
    learn_intervals: Annotated[
        Path | None, typer.Option(help="Fit the interval models, write them to this file and exit.")
    ] = None,
    learn_fruit: Annotated[
        int, typer.Option(min=50, help="Number of stress-set fruit for fitting the intervals.")
    ] = 1600,
    learn_set: Annotated[
        Path | None,
        typer.Option(help="Set from 'synth' with depth, for the intervals of network masks."),
    ] = None,
) -> None:
    """Measure simulated fruit of known length by every method.

    Includes the paper's 48 captures and five validation fruit with exact, disturbed and perceived
    masks, and a stress set: tilted, bent, occluded, distant, wet and sunlit fruit.
    """
    from cucumbervision_lab.evaluate.measure_case import require_extra

    require_extra()  # before an hour of measuring
    from cucumbervision_lab.evaluate import benchmark as run
    from cucumbervision_lab.evaluate.benchmark_report import benchmark_tables, write_tables

    if learn_intervals is not None:
        from cucumbervision_lab.evaluate.scenes import learn_intervals as learn

        if learn_set is None:
            raise typer.BadParameter("--learn-intervals requires --learn-set, a set from 'synth'")
        with part_bars() as report:
            book = learn(learn_intervals, out, learn_fruit, learn_set, workers, report)
        for key, model in book.models.items():
            show(f"{key}: {model.bands[''].count} readings")
        show(f"{book.fruit} fruit, level {book.level:.0%}, in {learn_intervals}")
        return
    plan = run.BenchmarkOptions(quick, stress, workers)
    with part_bars() as report:
        readings = run.run_benchmark(plan, out, report)
    tables = benchmark_tables(readings)
    show_tables(tables)
    show(f"Results: {write_tables(out / 'benchmark.json', run.provenance(plan), tables)}")
