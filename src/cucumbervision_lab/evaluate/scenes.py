"""Evaluate the networks on a labelled set or on audited photos; learn intervals from a drawn set.

`audit/annotations.json` holds labels of real photos: a COCO data set without its pictures, which
are not distributed. Each is named by the first digits of its SHA-1, so the layout of a folder of
photos does not matter. The notes in the file describe how the boxes were drawn and why a scene
belongs to its split.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
from scipy.stats import chi2

from cucumbervision.capture.frames import Capture
from cucumbervision.capture.pictures import read_color
from cucumbervision.errors import DataSetError
from cucumbervision.fruit.instance import Instance, MaskSource
from cucumbervision.fruit.label_files import parse_yolo_line
from cucumbervision.fruit.mask_codes import fill_polygon
from cucumbervision.fruit.masks import box_iou, box_ious, box_of_mask, share_inside
from cucumbervision.methods.intervals import IntervalModels
from cucumbervision.methods.pose import stem_first
from cucumbervision.methods.result import Fruit, FruitPose, Part
from cucumbervision_lab.arrays import Array, Pixels, Progress
from cucumbervision_lab.data.coco import read_coco
from cucumbervision_lab.data.labels import DataSet, Label, LabelledPicture, list_pictures, ticked
from cucumbervision_lab.evaluate import measure_case, pictures
from cucumbervision_lab.evaluate.benchmark import (
    fit_interval_models,
    package_finder,
    run_cases,
    write_interval_models,
)
from cucumbervision_lab.evaluate.cases import stress_cases
from cucumbervision_lab.evaluate.outcomes import Evaluation, match_detections, match_fruit
from cucumbervision_lab.processes import kept_rows

Report = Callable[[str, int, int], None]


def evaluate_detection(
    data: DataSet, networks: pictures.Networks, sam_limit: int = 40, report: Progress | None = None
) -> Evaluation:
    """Run the networks on every picture of a data set, and measure the lengths of its fruit.

    Parameters
    ----------
    data : DataSet
        Of `read_held_out`.
    networks : Networks
        Of `open_networks`; without a segmenter, lengths are measured on the detector's masks.
    sam_limit : int
        Maximum number of pictures for SAM and lengths, evenly spaced.
    report : callable, optional
        Called with 1 after each picture.

    Raises
    ------
    MissingExtraError
        If pycocotools is not installed.
    """
    start = time.perf_counter()
    pictures.import_pycocotools()
    measured = {picture.file for picture in pictures.spread(data.pictures, sam_limit)}
    frames: list[pictures.Frame] = []
    records: list[measure_case.Row] = []
    seconds: dict[str, list[float]] = {}
    for picture in ticked(data.pictures, report):
        color = read_color(data.path(picture))
        capture = pictures.capture_of(picture, data, color)
        depth_m = None if capture is None else capture.depth_m
        focal_px = None if capture is None else capture.intrinsics.fx_px
        frame = pictures.frame_of(picture, data, depth_m)
        frame, kept, durations = pictures.detect_picture(frame, color, networks, depth_m, focal_px)
        if picture.file in measured and capture is not None:
            instances = found_by_fruit(frame, kept, networks.confidence)
            if networks.segmenter is not None:
                drawn = networks.segmenter.segment(color, list(instances.values()))
                instances = dict(zip(instances, drawn, strict=True))
            records += length_records(frame, capture, instances)
        frames.append(frame)
        for name, duration in durations.items():
            seconds.setdefault(name, []).append(duration)
    readings = measure_case.readings_frame(records) if records else pd.DataFrame()
    duration_s = time.perf_counter() - start
    return Evaluation(data, networks, tuple(frames), readings, seconds, duration_s)


def found_by_fruit(
    frame: pictures.Frame, kept: Sequence[Instance], confidence: float
) -> dict[int, Instance]:
    """Return the reported instance of each detected fruit, by its index in `Frame.true`."""
    matches, _ = match_detections(frame, confidence, pictures.Stage.KEPT)
    return {fruit: kept[index] for fruit, index in matches.pairs}


def length_records(
    frame: pictures.Frame, capture: Capture, perceived: Mapping[int, Instance]
) -> list[measure_case.Row]:
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
        records.append(
            _row(frame, number, capture, _true_instance(frame, number), measure_case.Masks.EXACT)
        )
        records.append(_row(frame, number, capture, instance, measure_case.Masks.PERCEIVED))
    return records


def _true_instance(frame: pictures.Frame, number: int) -> Instance:
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
    turned = stem_first(measured.selected, measured.instance, capture)[0] is not measured.selected
    run = axis_m[0] - axis_m[-1]
    hangs = bool(run @ capture.gravity > 0.5 * np.linalg.norm(run))
    return {"hangs": hangs, "swapped_by_gravity": swapped != turned}


def _row(
    frame: pictures.Frame,
    number: int,
    capture: Capture,
    instance: Instance | None,
    masks: measure_case.Masks,
) -> measure_case.Row:
    fruit, name = frame.true[number], f"{frame.name}#{number}"
    assert fruit.mask is not None
    readings, measured = measure_case.fruit_readings(
        replace(capture, gravity=None), instance, fruit.mask
    )
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
    masks = (measure_case.Masks.EXACT, measure_case.Masks.DISTURBED)
    records = run_cases(cases, masks, out / "learning.jsonl", workers, tell)
    records += set_records(drawn, "all", out / "pictures.jsonl", workers, report)
    book = fit_interval_models(measure_case.readings_frame(records))
    write_interval_models(file, book)
    return book


def set_records(
    folder: Path, split: str, keep: Path, workers: int = 1, report: Report | None = None
) -> list[measure_case.Row]:
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
    held = pictures.read_held_out(folder, split)
    tell = None if report is None else (lambda n: report("pictures", n, len(held.pictures)))
    jobs = {picture.file: picture for picture in held.pictures}
    return kept_rows(keep, jobs, partial(_measured, held), workers, tell)


def _measured(data: DataSet, picture: LabelledPicture) -> list[measure_case.Row]:
    capture = pictures.capture_of(picture, data, read_color(data.path(picture)))
    if capture is None:
        return []
    frame, instances = (
        pictures.frame_of(picture, data, None),
        package_finder().find(capture).instances,
    )
    matches = match_fruit(frame, [instance.box for instance in instances])
    perceived = {number: instances[index] for number, index in matches.pairs}
    return length_records(frame, capture, perceived)


_HASH_DIGITS = 12
_OUTLINES = "labels_seg"
_SAME_IOU = 0.9


@lru_cache(maxsize=1)
def load_audit() -> DataSet:
    """Read the packaged audit.

    Its classes are 'cucumber' and 'zucchini', whole fruit of which at least about 70 % is visible;
    what is neither to be found nor a fault is ignored. `Label.extras` has, if known, 'stem', the
    side of the box at which the stem end lies; the two ends are keypoints. `extras` of a picture
    has 'name', 'collection', 'setting' ('trial', the black board of a breeding trial, 'board',
    'plate', 'hand', 'cart', 'crate', 'heap', 'plant', 'ground', 'white', 'parts' if all fruit are
    ignored, 'none' without fruit), 'test' and 'fully_labelled' (no ignore region is larger than
    half of the picture: others may contain much unlabelled fruit).

    Examples
    --------
    >>> audit = load_audit().in_split("test")
    >>> first = [photo for photo in audit if photo.extras["test"] == "first audit"]
    >>> sum(not label.ignore for photo in first for label in photo.labels)
    86
    """
    return read_coco(Path(__file__).parent / "audit")


def audited(
    folder: Path, split: str = "", audit: DataSet | None = None, *, outlines: bool = False
) -> DataSet:
    """Return the audited photos of a folder as a data set.

    Parameters
    ----------
    folder : Path
        Folder searched recursively for JPEG and PNG files.
    split : str
        'train', 'val', 'test', or '' for all.
    audit : DataSet, optional
        Audit to use instead of the packaged one.
    outlines : bool
        Use the publisher's polygons (`labels_seg` next to `images`) as masks if they match the
        audited boxes.

    Returns
    -------
    DataSet
        As `load_audit`; files that are not in the audit are skipped.

    Raises
    ------
    DataSetError
        If the folder contains no audited photo.
    """
    book = load_audit() if audit is None else audit
    files: dict[str, Path] = {}
    for path in list_pictures(folder):
        sha1 = hashlib.sha1(path.read_bytes(), usedforsecurity=False).hexdigest()
        files.setdefault(sha1[:_HASH_DIGITS], path)
    photos = [
        replace(photo, file=files[photo.file].relative_to(folder).as_posix())
        for photo in book.pictures
        if photo.file in files and split in ("", photo.split)
    ]
    if not photos:
        raise DataSetError(
            "contains no audited photo", source=folder, remedy="give the folder with the photos"
        )
    if outlines:
        photos = [_outlined(photo, folder / photo.file) for photo in photos]
    return replace(book, folder=folder, pictures=tuple(photos))


def _outlined(picture: LabelledPicture, path: Path) -> LabelledPicture:
    """Add the best-matching polygon to each fruit as its mask, using each polygon once."""
    file = path.parent.parent / _OUTLINES / f"{path.stem}.txt"
    if path.parent.name != "images" or not file.is_file():
        return picture
    size = np.array([picture.width, picture.height], np.float64)
    shapes = []
    for line in file.read_text(encoding="utf-8").splitlines():
        polygons = parse_yolo_line(line, "", [], (0, 0)).polygons if line.strip() else ()
        masks = [fill_polygon(points * size, picture.height, picture.width) for points in polygons]
        shapes += [Label.of_mask(mask) for mask in masks if mask.any()]
    labels = []
    for label in picture.labels:
        fits = [0.0 if label.ignore else box_iou(label.box, shape.box) for shape in shapes]
        if fits and max(fits) >= _SAME_IOU:
            label = replace(label, mask_code=shapes.pop(int(np.argmax(fits))).mask_code)
        labels.append(label)
    return replace(picture, labels=tuple(labels))


_GREY = 114  # letterbox padding


def audited_photos(folder: Path, split: str = "test") -> tuple[DataSet, int]:
    """Return the audited photos of a folder, and how many of the audit's are missing.

    Parameters
    ----------
    folder : Path
        Folder, searched recursively.
    split : str
        Split of the audit; no network was trained on 'test'.

    Raises
    ------
    DataSetError
        If the folder contains no audited photo.
    """
    data = audited(folder, split)
    return data, len(load_audit().in_split(split)) - len(data.pictures)


def photo_truth(picture: LabelledPicture, data: DataSet) -> pictures.Frame:
    """Return the labels of an audited photo for evaluation, without the masks by networks."""
    frame = pictures.frame_of(picture, data, None)
    return replace(frame, true=tuple(replace(label, mask_code=None) for label in frame.true))


def evaluate_photos(
    data: DataSet, networks: pictures.Networks, missing: int = 0, report: Progress | None = None
) -> Evaluation:
    """Run the networks on photos, at full and at half size.

    Parameters
    ----------
    data : DataSet
        Photos from `audited_photos`.
    networks : Networks
        Networks to evaluate.
    missing : int
        Number of audited photos that are missing.
    report : callable, optional
        Called with 1 after each photo.

    Raises
    ------
    CaptureError
        If a photo cannot be read.
    """
    frames, small = [], []
    for picture in ticked(data.pictures, report):
        color, truth = read_color(data.path(picture)), photo_truth(picture, data)
        frames.append(pictures.detect_picture(truth, color, networks)[0])
        small.append(pictures.detect_picture(*half_size(truth, color), networks)[0])
    return Evaluation(data, networks, tuple(frames), small=tuple(small), missing=missing)


def half_size(truth: pictures.Frame, color: Pixels) -> tuple[pictures.Frame, Pixels]:
    """Return a photo at half size, centred in a grey picture of the original size.

    Without the padding, a network would scale the smaller picture up to its input size, so the
    fruit would only be blurred.

    Parameters
    ----------
    truth : Frame
        Labels of the photo.
    color : ndarray of uint8, shape (H, W, 3)
        The photo, RGB.

    Returns
    -------
    truth : Frame
        Labels with transformed boxes and without keypoints.
    color : ndarray of uint8, shape (H, W, 3)
        The padded picture.

    Examples
    --------
    >>> from cucumbervision_lab.data.labels import Label
    >>> from cucumbervision_lab.evaluate.pictures import Frame
    >>> frame = Frame("a.jpg", "s", 8, 4, (Label(np.array([-0.5, -0.5, 7.5, 3.5])),))
    >>> truth, color = half_size(frame, np.zeros((4, 8, 3), np.uint8))
    >>> truth.true[0].box.tolist()
    [1.5, 0.5, 5.5, 2.5]
    >>> color[:, :, 0].tolist()[1]
    [114, 114, 0, 0, 0, 0, 114, 114]
    """
    height, width = color.shape[:2]
    inner = cv2.resize(color, (width // 2, height // 2), interpolation=cv2.INTER_AREA)
    rows, columns = inner.shape[:2]
    top, margin = (height - rows) // 2, (width - columns) // 2
    out = np.full_like(color, _GREY)
    out[top : top + rows, margin : margin + columns] = inner
    gain = np.tile([columns / width, rows / height], 2)
    true_fruit = tuple(
        replace(
            fruit, box=(fruit.box + 0.5) * gain + np.tile([margin, top], 2) - 0.5, keypoints=None
        )
        for fruit in truth.true
    )
    return replace(truth, true=true_fruit), out


_AMBIGUOUS_OVERLAP = 0.3  # unmatched detections that overlap a fruit by more are not negatives


def true_positives(frame: pictures.Frame, boxes: Array) -> list[bool | None]:
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
