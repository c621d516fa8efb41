"""Learn the intervals of lengths from what the networks see in drawn scenes."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.capture.pictures import read_color
from cucumbervision.instances.boxes import box_ious, share_inside
from cucumbervision_lab.benchmark.cases import stress_cases
from cucumbervision_lab.benchmark.interval_fit import write_interval_models
from cucumbervision_lab.benchmark.measure_case import CaseOptions
from cucumbervision_lab.benchmark.records import Masks, append_record, read_records, readings_frame
from cucumbervision_lab.benchmark.run import fit_interval_models, package_finder, run_cases
from cucumbervision_lab.datasets.labels import ticked
from cucumbervision_lab.detection.outcomes import match_fruit
from cucumbervision_lab.detection.pictures import capture_of, frame_of, read_held_out
from cucumbervision_lab.detection.run import length_records
from cucumbervision_lab.processes import each_done

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from cucumbervision.measurement.intervals import IntervalModels
    from cucumbervision_lab.benchmark.records import LengthRecord
    from cucumbervision_lab.datasets.labels import DataSet, LabelledPicture

    Report = Callable[[str, int, int], None]

    from numpy.typing import NDArray

    from cucumbervision_lab.detection.pictures import Frame


# Case numbers not used by any benchmark.
_LEARN_FIRST = 1_000_000


def learn_intervals(
    file: Path,
    out: Path,
    fruit: int,
    drawn: Path,
    workers: int = 1,
    report: Report | None = None,
) -> IntervalModels:
    """Fit all interval models, on fruit that no benchmark uses.

    Parameters
    ----------
    file : Path
        Output file of the models.
    out : Path
        Folder of the measurement records, used to resume an interrupted run.
    fruit : int
        Number of stress-set fruit, measured with exact and with disturbed outlines, so that the
        models can use the roughness of the outline.
    drawn : Path
        Set written by `synth` with depth, measured on true and on predicted masks.
    workers : int
        Number of processes.
    report : callable, optional
        See `run_benchmark`.
    """
    cases = stress_cases(fruit, first=_LEARN_FIRST)
    tell = None if report is None else (lambda count: report("stress fruit", count, fruit))
    options = CaseOptions((Masks.EXACT, Masks.DISTURBED))
    records = run_cases(cases, options, out / "learning.jsonl", workers, tell)
    records += set_records(drawn, "all", out / "pictures.jsonl", workers, report)
    book = fit_interval_models(readings_frame(records))
    write_interval_models(file, book)
    return book


def set_records(
    folder: Path, split: str, keep: Path, workers: int = 1, report: Report | None = None
) -> list[LengthRecord]:
    """Measure the fruit of a synthetic set on true masks and on masks of the packaged networks.

    Parameters
    ----------
    folder : Path
        Set with depth.
    split : str
        Split to measure, or 'all'.
    keep : Path
        JSON lines file of finished records, which are not measured again. Delete it when the
        networks or the methods change.
    workers : int
        Number of processes.
    report : callable, optional
        See `run_benchmark`.

    Raises
    ------
    DataSetError
        If the set cannot be read.
    """
    held = read_held_out(folder, split)
    done = read_records([keep]) if keep.exists() else []
    names = {_picture_of(record) for record in done}
    missing = [picture for picture in held.pictures if picture.file not in names]
    tell = None if report is None else (lambda n: report("pictures", n, len(held.pictures)))
    if tell is not None and names:
        tell(len(held.pictures) - len(missing))
    keep.parent.mkdir(parents=True, exist_ok=True)
    for records_of_picture in ticked(each_done(partial(_measured, held), missing, workers), tell):
        for record in records_of_picture:
            append_record(keep, record)
        done += records_of_picture
    chosen = {picture.file for picture in held.pictures}
    return [record for record in done if _picture_of(record) in chosen]


def _picture_of(record: LengthRecord) -> str:
    return record.case.partition("#")[0]


def _measured(data: DataSet, picture: LabelledPicture) -> list[LengthRecord]:
    capture = capture_of(picture, data, read_color(data.path(picture)))
    if capture is None:
        return []
    frame, instances = frame_of(picture, data, None), package_finder().find(capture).instances
    matches, required = match_fruit(frame, [instance.box for instance in instances])
    perceived = {required[number]: instances[index] for number, index in matches.pairs}
    return length_records(frame, capture, perceived)


_AMBIGUOUS_OVERLAP = 0.3  # unmatched detections that overlap a fruit by more are not negatives


def true_positives(frame: Frame, boxes: NDArray[np.float64]) -> list[bool | None]:
    """Return whether each box is a true positive; None for duplicates and parts of a fruit."""
    boxes = boxes.reshape(-1, 4)
    hits = {index for _, index in match_fruit(frame, list(boxes))[0].pairs}
    true_boxes = np.array([fruit.box for fruit in frame.true]).reshape(-1, 4)
    on_fruit = np.maximum(
        box_ious(boxes, true_boxes).max(axis=1, initial=0.0), share_inside(boxes, true_boxes)
    )
    return [
        True if k in hits else None if on_fruit[k] > _AMBIGUOUS_OVERLAP else False
        for k in range(len(boxes))
    ]
