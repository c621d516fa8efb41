"""Crops around what the detector finds, to train the network that looks at each fruit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any, TypeAlias
from zlib import crc32

import cv2
import numpy as np
from numpy.typing import NDArray

from cucumbervision.capture.pictures import read_color
from cucumbervision.errors import TrainingError
from cucumbervision.files import write_bytes
from cucumbervision.fruit.crops import HEIGHT_PX, PLANES, WIDTH_PX, FruitCrop, fruit_crop
from cucumbervision.fruit.instance import Instance
from cucumbervision.fruit.masks import box_ious, mask_iou
from cucumbervision.networks import CANDIDATE_CONFIDENCE
from cucumbervision.networks.find import NetworkLoader
from cucumbervision.networks.yolo import YoloDetector
from cucumbervision_lab.arrays import Array, Mask, Pixels, Progress
from cucumbervision_lab.data.labels import KEYPOINT_ORDER, DataSet, Label, LabelledPicture
from cucumbervision_lab.data.splits import is_held_out
from cucumbervision_lab.evaluate.pictures import capture_of, frame_of
from cucumbervision_lab.evaluate.scenes import true_positives

SURROUND_PX = (HEIGHT_PX + 16, WIDTH_PX + 32)
"""Size of the crops to train on: larger than the network sees, to move it in."""

_HELD_OUT = 8  # one of so many scenes is used for validation, as is the split val
_MOST = 12  # candidates of a picture that are cut out
_LEAST_IOU = 0.3  # of a detection's mask with a label's
_KEPT_TOGETHER = 50  # pictures

FRUIT_CROP = np.dtype(
    [
        ("planes", np.uint8, (*SURROUND_PX, PLANES)),
        ("outlines", np.uint8, SURROUND_PX),
        ("has_outline", np.bool_),
        ("points", np.float32, (5, 2)),
        ("visible", np.float32, (5,)),
        ("stem", np.float32),
        ("is_fruit", np.float32),
        ("confidence", np.float32),
        ("held_out", np.bool_),
    ],
    align=True,  # as torch wants arrays
)
"""Crops around what a detector proposes.

`planes` as `FruitCrop.planes`; `outlines`, the share of each pixel that belongs to the visible
fruit, 0 to 255, and whether it is known; `points`, the keypoints from the left end to the right one
in pixels of the crop's middle part of 112 by 256, and whether each is visible; `stem`, whether the
right end is the stem end; `is_fruit`, whether it is a cucumber, NaN for parts of one and ignored
regions; the detector's `confidence`, 0 to 1; `held_out`, whether the scene belongs to the
validation set. What is not known is NaN.
"""

Crops: TypeAlias = "np.recarray[Any, Any]"
"""Crops with a field for each of their properties."""


def crops_of(rows: Sequence[tuple[Any, ...]], kind: np.dtype[Any]) -> Crops:
    """Return rows of fields as an array of crops.

    Examples
    --------
    >>> crops_of([(0.5, True)], np.dtype([("missing", float), ("moved", bool)])).missing
    array([0.5])
    """
    return np.array(list(rows), kind).view(np.recarray)


def collect_sets(sets: Sequence[DataSet], keep: Path, progress: Progress | None = None) -> Crops:
    """Cut out what the packaged detector proposes in data sets.

    Parameters
    ----------
    sets : sequence of DataSet
        As for `collect_fruit_crops`.
    keep : Path
        Folder for the crops of some pictures each, so that an interrupted run goes on.
    progress : callable, optional
        Called with the number of pictures that were read since the last call.

    Raises
    ------
    TrainingError
        If there are too few scenes to hold some out.
    CaptureError
        If a picture cannot be read.
    """
    keep.mkdir(parents=True, exist_ok=True)
    parts, detector = [], None
    for number, dataset in enumerate(sets):
        for start in range(0, len(dataset.pictures), _KEPT_TOGETHER):
            pictures = dataset.pictures[start : start + _KEPT_TOGETHER]
            identity = f"{[(picture.file, len(picture.labels)) for picture in pictures]}"
            file = keep / f"{number}-{start:06d}-{crc32(identity.encode()):08x}.npy"
            if not file.exists():
                detector = detector or proposing_detector()
                crops = collect_fruit_crops(replace(dataset, pictures=pictures), detector)
                packed = BytesIO()
                np.save(packed, crops)
                write_bytes(file, packed.getvalue())
            parts.append(np.load(file))
            if progress is not None:
                progress(len(pictures))
    joined: Crops = np.concatenate([crops_of([], FRUIT_CROP), *parts]).view(np.recarray)
    taught = joined.has_outline | ~np.isnan(joined.is_fruit) | ~np.isnan(joined.points).any((1, 2))
    if not (taught & joined.held_out).any() or joined.held_out[taught].all():
        raise TrainingError(
            "too few scenes in which the detector proposes anything",
            source=sets[0].folder if sets else None,
            remedy=f"give at least {_HELD_OUT} scenes with fruit",
        )
    learnt: Crops = joined[taught]
    return learnt


def collect_fruit_crops(dataset: DataSet, detector: YoloDetector | None = None) -> Crops:
    """Cut out what the packaged detector proposes in a data set.

    Parameters
    ----------
    dataset : DataSet
        Completely labelled pictures, also such without fruit. Those of the split 'test' are
        skipped; the split 'val' is used for validation.
    detector : YoloDetector, optional
        Result of `proposing_detector`, which is loaded if it is not given.

    Returns
    -------
    recarray of FRUIT_CROP

    Raises
    ------
    CaptureError
        If a picture cannot be read.
    """
    detector = proposing_detector() if detector is None else detector
    rows: list[tuple[Any, ...]] = []
    for picture in dataset.pictures:
        if picture.split == "test":
            continue
        held = is_held_out(picture, _HELD_OUT)
        color = read_color(dataset.path(picture))
        capture = capture_of(picture, dataset, color)
        depth_m = None if capture is None else capture.depth_m
        focal_px = None if capture is None else capture.intrinsics.fx_px
        instances = detector.detect(color)[:_MOST]
        verdicts = _labels_of(picture, dataset, instances)
        for instance, is_fruit in zip(instances, verdicts, strict=True):
            if instance.detector_mask is None:
                continue
            crop = fruit_crop(color, depth_m, instance.detector_mask, focal_px, SURROUND_PX)
            if crop is not None:
                rows.append((*_row(crop, instance, is_fruit, picture), instance.confidence, held))
    return crops_of(rows, FRUIT_CROP)


def proposing_detector() -> YoloDetector:
    """Load the packaged detector, which reports what it hardly believes, too."""
    loader = NetworkLoader(confidence=CANDIDATE_CONFIDENCE, most_fruit=4 * _MOST)
    return loader.yolo("cucumber-seg")


def _labels_of(
    picture: LabelledPicture, data: DataSet, instances: Sequence[Instance]
) -> list[bool | None]:
    """Return whether each detection is a true positive; None where the labels leave it open."""
    boxes = np.array([instance.box for instance in instances]).reshape(-1, 4)
    frame = frame_of(picture, data, None)
    unknown = np.array([fruit.box for fruit in frame.true if fruit.ignore or fruit.optional])
    overlap = box_ious(boxes, unknown.reshape(-1, 4)).max(axis=1, initial=0.0)
    judged = true_positives(frame, boxes)
    return [None if share > 0 and not y else y for y, share in zip(judged, overlap, strict=True)]


def _row(
    crop: FruitCrop, instance: Instance, is_fruit: bool | None, picture: LabelledPicture
) -> tuple[Any, ...]:
    outline = np.zeros(SURROUND_PX, np.uint8)
    points, visible, stem = np.full((5, 2), np.nan), np.full(5, np.nan), np.nan
    label = _label_of(instance, picture)
    verdict = np.nan if is_fruit is None else float(is_fruit)
    if label is None:  # nothing of a cucumber is there, where all are labelled
        return crop.planes, outline, is_fruit is False, points, visible, stem, verdict
    mask = label.mask
    has_outline = mask is not None and not label.ignore
    if mask is not None and has_outline:
        outline = outline_in_crop(crop, mask)
    if label.keypoints is not None and not label.ignore:
        points, visible, stem = _points_of(crop, label)
    return crop.planes, outline, has_outline, points, visible, stem, verdict


def _label_of(instance: Instance, picture: LabelledPicture) -> Label | None:
    """Return the label with which a detection's mask agrees best."""
    best, best_iou = None, _LEAST_IOU
    for label in picture.labels:
        if label.mask_code is None or instance.detector_mask is None:
            continue
        apart = (label.box[:2] > instance.box[2:]) | (label.box[2:] < instance.box[:2])
        if apart.any():
            continue
        iou = mask_iou(label.mask_code.decode(), instance.detector_mask)
        if iou > best_iou:
            best, best_iou = label, iou
    return best


def outline_in_crop(crop: FruitCrop, mask: Mask) -> Pixels:
    """Return the share of each crop pixel that a mask covers, 0 to 255."""
    height, width = crop.planes.shape[:2]
    middle = np.array([(width - 1) / 2, (height - 1) / 2])
    to_picture = np.column_stack([crop.axes.T, crop.middle_px - middle @ crop.axes])
    picture: NDArray[Any] = mask.astype(np.float32)
    if crop.step_px > 1:
        side = int(np.ceil(crop.step_px)) | 1
        picture = cv2.GaussianBlur(picture, (0, 0), crop.step_px / 3) if side > 1 else picture
    warped = cv2.warpAffine(
        picture, to_picture, (width, height), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    )
    return np.asarray(np.rint(255 * np.clip(warped, 0, 1)), np.uint8)


def _points_of(crop: FruitCrop, label: Label) -> tuple[Array, Array, float]:
    keypoints = np.asarray(label.keypoints, np.float64)
    labelled = keypoints[:, 2] > 0
    points = np.where(labelled[:, None], crop.to_crop(keypoints[:, :2]), np.nan)
    visible = np.where(labelled, (keypoints[:, 2] > 1).astype(float), np.nan)
    ends = points[[0, -1], 0]
    ordered = label.extras.get(KEYPOINT_ORDER) is None
    if np.isnan(ends).any():
        return np.full((5, 2), np.nan), np.full(5, np.nan), np.nan
    turned = ends[0] > ends[1]
    if turned:
        points, visible = points[::-1], visible[::-1]
    return points, visible, float(not turned) if ordered else np.nan
