"""Evaluate the networks on a labelled set; learn intervals from what they see in a drawn one."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import chi2

from cucumbervision.capture.frames import Capture
from cucumbervision.capture.pictures import read_color
from cucumbervision.fruit.instance import Instance, MaskSource
from cucumbervision.fruit.masks import box_ious, box_of_mask, share_inside
from cucumbervision.methods.intervals import IntervalModels
from cucumbervision.methods.pose import stem_first
from cucumbervision.methods.result import Fruit, FruitPose, Part
from cucumbervision.networks import DEFAULT_CONFIDENCE
from cucumbervision_lab.arrays import Array
from cucumbervision_lab.data.labels import DataSet, LabelledPicture
from cucumbervision_lab.evaluate.benchmark import (
    fit_interval_models,
    package_finder,
    run_cases,
    write_interval_models,
)
from cucumbervision_lab.evaluate.cases import stress_cases
from cucumbervision_lab.evaluate.measure_case import (
    CaseOptions,
    Masks,
    Row,
    fruit_readings,
    readings_frame,
)
from cucumbervision_lab.evaluate.outcomes import match_detections, match_fruit
from cucumbervision_lab.evaluate.pictures import (
    Frame,
    PictureResult,
    Stage,
    capture_of,
    detect_picture,
    frame_of,
    import_pycocotools,
    open_networks,
    read_held_out,
    spread,
)
from cucumbervision_lab.processes import kept_rows

Report = Callable[[str, int, int], None]


@dataclass(frozen=True, eq=False)
class DetectionResult:
    """Results of an evaluation.

    Parameters
    ----------
    data : Path
        The labelled set.
    split : str
        The evaluated split.
    confidence : float
        Confidence threshold for recall and precision.
    input_sizes : tuple of int
        Long sides of the detector input, pixels; empty for the network's default.
    frames : tuple of Frame
        Labels and detections.
    readings : DataFrame
        Lengths on true and on predicted masks, see `readings_frame`; may be empty.
    models : list of dict
        File, SHA-256 and runtime of each network.
    seconds : dict of str to list of float
        Run time of each network for each picture.
    duration_s : float
        Total duration.
    """

    data: Path
    split: str
    confidence: float
    input_sizes: tuple[int, ...]
    frames: tuple[Frame, ...]
    readings: pd.DataFrame
    models: list[dict[str, Any]]
    seconds: dict[str, list[float]]
    duration_s: float


def evaluate_detection(
    data: Path,
    segment: Path | None = None,
    pose: Path | None = None,
    *,
    segmenter: str | None = "mobile-sam",
    runtime: str = "auto",
    confidence: float = DEFAULT_CONFIDENCE,
    split: str = "test",
    limit: int | None = None,
    sam_limit: int = 40,
    input_sizes: tuple[int, ...] = (),
    report: Callable[[str, int, int], None] | None = None,
) -> DetectionResult:
    """Run the networks on every picture of a split.

    Parameters
    ----------
    data : Path
        The labelled set.
    segment, pose : Path, optional
        ONNX files; by default the networks of the registry.
    segmenter : str, optional
        Name of a SAM in the registry; None measures on the detector's masks.
    runtime, confidence, input_sizes
        See `open_networks`.
    split : str
        Split of the set.
    limit, sam_limit : int, optional
        Maximum number of pictures, and of those for SAM and lengths, evenly spaced.
    report : callable, optional
        Called after each picture with the name of the step, the number of finished pictures since
        the last call, and their total.

    Raises
    ------
    DataSetError
        If the set is not suitable as a test.
    ModelError
        If a network is missing or cannot be loaded.
    MissingExtraError
        If pycocotools is not installed.
    """
    start = time.perf_counter()
    import_pycocotools()
    held_out = read_held_out(data, split, limit)
    networks = open_networks(
        segment, pose, segmenter, runtime=runtime, confidence=confidence, input_sizes=input_sizes
    )
    measured = {picture.file for picture in spread(held_out.pictures, sam_limit)}
    frames: list[Frame] = []
    records: list[Row] = []
    seconds: dict[str, list[float]] = {}
    for picture in held_out.pictures:
        color = read_color(held_out.path(picture))
        capture = capture_of(picture, held_out, color)
        depth_m = None if capture is None else capture.depth_m
        focal_px = None if capture is None else capture.intrinsics.fx_px
        frame = frame_of(picture, held_out, depth_m)
        result = detect_picture(frame, color, networks, depth_m, focal_px)
        if picture.file in measured and capture is not None:
            instances = found_by_fruit(result, networks.confidence)
            if networks.segmenter is not None:
                drawn = networks.segmenter.segment(color, list(instances.values()))
                instances = dict(zip(instances, drawn, strict=True))
            records += length_records(result.frame, capture, instances)
        frames.append(result.frame)
        for name, duration in result.seconds.items():
            seconds.setdefault(name, []).append(duration)
        if report is not None:
            report("pictures", 1, len(held_out.pictures))
    return DetectionResult(
        data,
        split,
        confidence,
        input_sizes,
        tuple(frames),
        readings_frame(records) if records else pd.DataFrame(),
        networks.models,
        seconds,
        time.perf_counter() - start,
    )


def found_by_fruit(result: PictureResult, confidence: float) -> dict[int, Instance]:
    """Return the reported instance of each detected fruit, by its index in `Frame.true`."""
    matches, _ = match_detections(result.frame, confidence, Stage.KEPT)
    return {fruit: result.kept[index] for fruit, index in matches.pairs}


def length_records(frame: Frame, capture: Capture, perceived: Mapping[int, Instance]) -> list[Row]:
    """Measure the fruit of a picture on true and on predicted masks.

    Parameters
    ----------
    frame : Frame
        Labels of the picture.
    capture : Capture
        Colour and depth of the picture.
    perceived : mapping of int to Instance
        Detected instances with masks and keypoints, by index in `frame.true`.

    Returns
    -------
    list of Row
        Two rows for each fruit to be detected with known lengths. The predicted one of a missed
        fruit has no lengths.
    """
    records = []
    for number, fruit in enumerate(frame.true):
        if not fruit.required or fruit.mask_code is None or "centreline_m" not in fruit.extras:
            continue
        instance = perceived.get(number)
        records.append(_row(frame, number, capture, _true_instance(frame, number), Masks.EXACT))
        records.append(_row(frame, number, capture, instance, Masks.PERCEIVED))
    return records


def _true_instance(frame: Frame, number: int) -> Instance:
    fruit = frame.true[number]
    mask = fruit.mask
    assert mask is not None
    points = None
    if fruit.keypoints is not None:
        points = np.column_stack([fruit.keypoints[:, :2], fruit.keypoints[:, 2] == 2])
    return Instance(box_of_mask(mask), mask=mask, mask_source=MaskSource.DATASET, keypoints=points)


def pose_errors(pose: FruitPose, axis_m: Array) -> dict[str, Any]:
    """Return how far a fruit's pose is from the true one.

    Parameters
    ----------
    pose : FruitPose
        As measured.
    axis_m : ndarray of float64, shape (K, 3)
        The true axis from blossom end to stem end, camera coordinates, metres.

    Returns
    -------
    dict
        `swapped` (the ends fit better the other way round), `stem_confidence`, `whole` (both ends
        are in sight); where they are right `stem_mm`, `stem_deg` and, for a fruit whose stem end
        is in sight, `cut_in_90`: whether the true place to cut lies within the ellipsoid of 90 %.

    Examples
    --------
    >>> from cucumbervision import example_captures, measure
    >>> pose = measure(example_captures() / "simulated-row-a", instances="dataset").fruit[0].pose
    >>> pose_errors(pose, pose.axis_m)["swapped"]
    True
    >>> errors = pose_errors(pose, pose.axis_m[::-1])
    >>> errors["stem_mm"], errors["cut_in_90"]
    (0.0, True)
    """
    blossom, stem = axis_m[0], axis_m[-1]
    ends = np.stack([pose.blossom_m, pose.stem_m])
    straight = np.linalg.norm(ends - [blossom, stem], axis=1).sum()
    swapped = bool(np.linalg.norm(ends - [stem, blossom], axis=1).sum() < straight)
    errors: dict[str, Any] = {"swapped": swapped, "stem_confidence": pose.stem_confidence}
    errors["whole"] = not {Part.STEM, Part.BLOSSOM} & set(pose.covered)
    if swapped:
        return errors
    out = (stem - axis_m[-2]) / np.linalg.norm(stem - axis_m[-2])
    errors["stem_mm"] = 1e3 * float(np.linalg.norm(pose.stem_m - stem))
    errors["stem_deg"] = float(np.degrees(np.arccos(np.clip(pose.direction @ out, -1, 1))))
    if pose.cut_m is not None and pose.cut_covariance_m2 is not None:
        beyond_m = float(np.linalg.norm(pose.cut_m - pose.stem_m))
        off = pose.cut_m - (stem + beyond_m * out)
        squared = float(off @ np.linalg.solve(pose.cut_covariance_m2, off))
        errors["cut_in_90"] = bool(squared <= chi2.ppf(0.9, 3))
    return errors


def _with_gravity(
    measured: Fruit, axis_m: Array, capture: Capture, swapped: bool
) -> dict[str, Any]:
    """Return what gravity would make of a pose's ends, and whether the fruit hangs."""
    if capture.gravity is None or measured.selected is None:
        return {}
    before = measured.selected
    after, sure = stem_first(before, measured.instance, capture)
    run = axis_m[0] - axis_m[-1]
    return {
        "hangs": bool(run @ capture.gravity > 0.5 * np.linalg.norm(run)),
        "swapped_by_gravity": swapped != (after is not before),
        "sure_by_gravity": sure,
    }


def _row(
    frame: Frame, number: int, capture: Capture, instance: Instance | None, masks: Masks
) -> Row:
    fruit, name = frame.true[number], f"{frame.name}#{number}"
    assert fruit.mask is not None
    readings, measured = fruit_readings(replace(capture, gravity=None), instance, fruit.mask)
    if measured is not None and measured.pose is not None and "axis_m" in fruit.extras:
        axis_m = np.array(fruit.extras["axis_m"])
        readings |= pose_errors(measured.pose, axis_m)
        readings |= _with_gravity(measured, axis_m, capture, readings["swapped"])
    return {
        "case": name,
        "suite": "detection",
        "masks": masks,
        "fruit": name,
        "scene": frame.scene,
        "missed": instance is None,
        "cut_off": bool(fruit.cut_off),
        "condition": "plain",
        "depth_scale": 1.0,
        "distance_m": fruit.distance_m,
        "tilt_deg": None,
        "bend_radius_m": None,
        "hidden_share": fruit.hidden_share,
        **{key: fruit.extras.get(key) for key in ("centreline_m", "thread_m", "chord_m")},
        **readings,
    }


# Case numbers not used by any benchmark.
_LEARN_FIRST = 1_000_000


def learn_intervals(
    file: Path, out: Path, fruit: int, drawn: Path, workers: int = 1, report: Report | None = None
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
) -> list[Row]:
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
    tell = None if report is None else (lambda n: report("pictures", n, len(held.pictures)))
    jobs = {picture.file: picture for picture in held.pictures}
    return kept_rows(keep, jobs, partial(_measured, held), workers, tell)


def _measured(data: DataSet, picture: LabelledPicture) -> list[Row]:
    capture = capture_of(picture, data, read_color(data.path(picture)))
    if capture is None:
        return []
    frame, instances = frame_of(picture, data, None), package_finder().find(capture).instances
    matches = match_fruit(frame, [instance.box for instance in instances])
    perceived = {number: instances[index] for number, index in matches.pairs}
    return length_records(frame, capture, perceived)


_AMBIGUOUS_OVERLAP = 0.3  # unmatched detections that overlap a fruit by more are not negatives


def true_positives(frame: Frame, boxes: Array) -> list[bool | None]:
    """Return whether each box is a true positive; None for duplicates and parts of a fruit."""
    boxes = boxes.reshape(-1, 4)
    hits = {index for _, index in match_fruit(frame, list(boxes)).pairs}
    true_boxes = np.array([fruit.box for fruit in frame.true]).reshape(-1, 4)
    on_fruit = np.maximum(
        box_ious(boxes, true_boxes).max(axis=1, initial=0.0), share_inside(boxes, true_boxes)
    )
    return [
        True if k in hits else None if on_fruit[k] > _AMBIGUOUS_OVERLAP else False
        for k in range(len(boxes))
    ]
