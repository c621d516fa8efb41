"""`cucumbervision benchmark` and `evaluate`: lengths, methods, networks and forecasts."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from cucumbervision.cli.choices import InputSize, Runtime
from cucumbervision.networks import DEFAULT_CONFIDENCE
from cucumbervision_lab.cli import data, part_bars, show, show_tables, ticking, train

Seg = Annotated[
    Path | None, typer.Option(help="YOLO segmentation .onnx; default: the packaged network.")
]
Pose = Annotated[Path | None, typer.Option(help="YOLO pose .onnx; default: the packaged network.")]
Confidence = Annotated[
    float, typer.Option(min=0.0, max=1.0, help="Confidence threshold for recall and precision.")
]


app = typer.Typer(
    name="evaluate",
    help="Compare lengths, or the networks, with ground truth.",
    no_args_is_help=True,
)


@app.command()
def lengths(
    measurements: Annotated[
        Path, typer.Argument(help="Folder of a `measure` run, or its measurements.json.")
    ],
    truth: Annotated[
        Path,
        typer.Argument(
            help="CSV: capture, fruit, length_cm, kind (thread, centreline or chord); optionally "
            "specimen, repeat, length_1_cm, length_2_cm …"
        ),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the tables.")],
) -> None:
    """Compare every method with hand-measured lengths: tables, CSV files, a Bland-Altman plot."""
    from cucumbervision.accuracy import own_truth
    from cucumbervision.accuracy.truth import read_truth
    from cucumbervision.files import write_csv
    from cucumbervision_lab import agreement

    measured = own_truth.read_measured(measurements)
    evaluation = own_truth.evaluate_lengths(measured, read_truth(truth))
    own_truth.write_own_truth(evaluation, out)
    rows, hidden = (
        agreement.agreement_rows(evaluation),
        agreement.hidden_table(measured, evaluation),
    )
    tables = [own_truth.scores_table(evaluation.scores)]
    if rows:
        write_csv(out / "agreement.csv", list(rows[0]), rows)
        tables.append(agreement.agreement_table(evaluation))
    show_tables([*tables, hidden] if hidden.rows else tables)
    show(*evaluation.notes)
    try:
        agreement.plot_agreement(evaluation, out)
    except ImportError:
        show("For the Bland-Altman plot: pip install 'cucumbervision[benchmark]'")
    show(f"The tables are in {out}/")


@app.command("models")
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
    from cucumbervision_lab.evaluate.pictures import open_networks, read_held_out
    from cucumbervision_lab.evaluate.report import detection_tables, write_detection_report
    from cucumbervision_lab.evaluate.scenes import evaluate_detection

    pictures = read_held_out(data, split, limit)
    how: dict[str, Any] = {"runtime": runtime, "confidence": confidence}
    sam, sizes = None if segmenter == "none" else segmenter, parse_input_sizes(input_size)
    networks = open_networks(seg, pose, sam, input_sizes=sizes, **how)
    with ticking("pictures", len(pictures.pictures)) as tick:
        result = evaluate_detection(pictures, networks, sam_limit, tick)
    tables = detection_tables(result)
    show_tables(tables)
    show(f"Results: {write_detection_report(result, tables, out)}")


@app.command("photos")
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
    from cucumbervision_lab.evaluate.pictures import open_networks
    from cucumbervision_lab.evaluate.report import photo_tables, write_photo_report
    from cucumbervision_lab.evaluate.scenes import audited_photos
    from cucumbervision_lab.evaluate.scenes import evaluate_photos as evaluate

    photos, missing = audited_photos(folder, split)
    how: dict[str, Any] = {"runtime": runtime, "confidence": confidence}
    sizes = parse_input_sizes(input_size)
    networks = open_networks(seg, pose, "mobile-sam", ranked=False, input_sizes=sizes, **how)
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
    harvests: Annotated[
        Path | None,
        typer.Option(
            help="Forecast the harvests in this folder instead: X_daily.csv and X_weekly.csv."
        ),
    ] = None,
) -> None:
    """Measure simulated fruit of known length by every method, or forecast harvests.

    Includes the paper's 48 captures and five validation fruit with exact, disturbed and perceived
    masks, and a stress set: tilted, bent, occluded, distant, wet and sunlit fruit.
    """
    from cucumbervision._version import __version__
    from cucumbervision.about import installed_versions
    from cucumbervision_lab.evaluate.benchmark import run_benchmark
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
    provenance: dict[str, Any] = {"software": f"cucumbervision {__version__}"}
    provenance["versions"] = installed_versions()
    if harvests is not None:
        from cucumbervision_lab.evaluate.harvests import harvest_tables

        tables = harvest_tables(harvests)
        show_tables(tables)
        show(f"Results: {write_tables(out / 'harvests.json', provenance, tables)}")
        return
    with part_bars() as report:
        readings = run_benchmark(out, quick=quick, stress=stress, workers=workers, report=report)
    provenance |= {"stress fruit": stress, "quick": quick}
    tables = benchmark_tables(readings)
    show_tables(tables)
    show(f"Results: {write_tables(out / 'benchmark.json', provenance, tables)}")


def register(program: typer.Typer, groups: Mapping[str, typer.Typer]) -> None:  # noqa: ARG001
    """Register the laboratory's commands.

    Parameters
    ----------
    program : typer.Typer
        The command `cucumbervision`.
    groups : mapping of str to typer.Typer
        Its command groups.
    """
    program.command("benchmark")(benchmark)
    program.command("synth")(data.synth)
    program.add_typer(data.app, name="data")
    program.add_typer(train.app, name="train")
    program.add_typer(app, name="evaluate")
