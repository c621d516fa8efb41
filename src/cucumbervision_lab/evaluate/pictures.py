"""Labelled test pictures with their detections, and reading them from a data set."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from cucumbervision.capture.frames import Capture
from cucumbervision.capture.pictures import depth_to_metres, read_color, read_depth
from cucumbervision.errors import DataSetError, MissingExtraError, ModelError
from cucumbervision.fruit.instance import Instance
from cucumbervision.fruit.mask_codes import Rle
from cucumbervision.methods.paper_methods import reference_depth
from cucumbervision.networks import CANDIDATE_CONFIDENCE, DEFAULT_CONFIDENCE
from cucumbervision.networks.find import (
    Detectors,
    FruitLooker,
    NetworkLoader,
    NetworkSegmenter,
    PictureLooks,
    each_fruit_once,
)
from cucumbervision.networks.keypoint_axis import place_keypoints
from cucumbervision.networks.yolo import YoloDetector, detector_floor, pose_floor
from cucumbervision_lab.arrays import Array32, Pixels
from cucumbervision_lab.data.checks import picture_faults, require_clean
from cucumbervision_lab.data.coco import read_coco
from cucumbervision_lab.data.labels import DataSet, Label, LabelledPicture

T = TypeVar("T")


def import_pycocotools() -> Any:
    """Import `pycocotools.mask`.

    Raises
    ------
    MissingExtraError
        If pycocotools is not installed.
    """
    try:
        from pycocotools import mask
    except ImportError:
        raise MissingExtraError("pycocotools", "benchmark") from None
    return mask


class Stage(StrEnum):
    """Processing stage whose detections are evaluated."""

    SEGMENTED = "segmentation network"
    POSED = "pose network"
    KEPT = "reported detections"


@dataclass(frozen=True, eq=False)
class Frame:
    """Labels and detections of one picture.

    Parameters
    ----------
    name : str
        File name, unique within the set.
    scene : str
        Scene; pictures of one scene are not independent samples.
    width, height : int
        Size, pixels.
    true : tuple of Label
        Labels.
    segmented, posed : tuple of Label
        Detections of the two networks at any confidence, best first.
    kept : tuple of Label
        Reported detections at the confidence threshold, without duplicates.
    has_masks : bool
        Whether the first network predicts masks.
    """

    name: str
    scene: str
    width: int
    height: int
    true: tuple[Label, ...] = ()
    segmented: tuple[Label, ...] = ()
    posed: tuple[Label, ...] = ()
    kept: tuple[Label, ...] = ()
    has_masks: bool = True

    def detections(self, stage: Stage) -> tuple[Label, ...]:
        """Return the detections of one stage."""
        return {Stage.SEGMENTED: self.segmented, Stage.POSED: self.posed, Stage.KEPT: self.kept}[
            stage
        ]


def coco_code(code: Rle) -> dict[str, Any]:
    """Return a mask as pycocotools takes it."""
    return {"size": [code.height, code.width], "counts": code.counts}


def detected_label(instance: Instance, depth_m: Array32 | None = None) -> Label:
    """Return a detection with its mask encoded, which saves memory.

    Parameters
    ----------
    instance : Instance
        Instance predicted by a network.
    depth_m : ndarray of float32, shape (H, W), optional
        Depth in metres. The distance is the median in the middle ninth of the box.
    """
    mask = instance.detector_mask
    distance_m = None if depth_m is None else reference_depth(depth_m, instance.box)
    return Label(
        instance.box,
        mask_code=None if mask is None else Rle.of(mask),
        keypoints=instance.keypoints,
        score=instance.confidence,
        distance_m=math.nan if distance_m is None else distance_m,
    )


DRAWN = "synth"
"""`LabelledPicture.source` of synthetic pictures."""

_FRUIT, _ALSO_FRUIT = "cucumber", "zucchini"


def read_held_out(folder: Path, split: str = "test", limit: int | None = None) -> DataSet:
    """Read the pictures of one split for evaluation, as a data set of these alone.

    Parameters
    ----------
    folder : Path
        Data set in COCO format.
    split : str
        Name of the split, or 'all'.
    limit : int, optional
        Maximum number of pictures, evenly spaced.

    Raises
    ------
    DataSetError
        If the set has invalid entries, the split is empty or contains pseudo-labels, or a picture
        is missing or has the wrong size.
    """
    data = read_coco(folder)
    pictures = data.pictures if split == "all" else data.in_split(split)
    if not pictures:
        splits = ", ".join(sorted({p.split for p in data.pictures if p.split})) or "none"
        raise DataSetError(
            f"the split {split!r} is empty (available: {splits})",
            source=folder,
            remedy="choose another --split, or 'all'",
        )
    pseudo = [
        p.file for p in pictures if any(label.pseudo and not label.ignore for label in p.labels)
    ]
    if pseudo:
        raise DataSetError(
            f"{len(pseudo)} pictures of the split {split!r} have pseudo-labels, first {pseudo[0]}",
            source=folder,
            remedy="move them to 'train'",
        )
    chosen = replace(data, pictures=spread(pictures, limit))
    # Labels that were not read would count as false positives.
    faults = [fault for picture in chosen.pictures for fault in picture_faults(chosen, picture)]
    require_clean([*data.refused, *faults], folder)
    return chosen


def spread(items: Sequence[T], limit: int | None) -> tuple[T, ...]:
    """Return at most `limit` evenly spaced items.

    Examples
    --------
    >>> spread(("a", "b", "c", "d", "e"), 3)
    ('a', 'c', 'e')
    """
    if limit is None or limit >= len(items):
        return tuple(items)
    return tuple(items[k] for k in np.linspace(0, len(items) - 1, limit).round().astype(int))


def frame_of(picture: LabelledPicture, data: DataSet, depth_m: Array32 | None) -> Frame:
    """Return the labels of a picture for evaluation.

    Cucumbers must be detected, zucchini are optional, and other classes are background.

    Parameters
    ----------
    picture : LabelledPicture
        Labelled picture.
    data : DataSet
        Data set with the class names.
    depth_m : ndarray of float32, shape (H, W), optional
        Depth in metres, for the distance of fruit without the label 'distance_m'.
    """
    true = []
    for label in picture.labels:
        name = data.categories[label.category].lower()
        # A single class is the fruit, regardless of its name.
        fruit, optional = len(data.categories) == 1 or name == _FRUIT, name == _ALSO_FRUIT
        if fruit or optional or label.ignore:
            distance_m = _distance_m(label, depth_m)
            true.append(replace(label, optional=optional, distance_m=distance_m))
    scene = picture.scene or picture.file
    return Frame(picture.file, scene, picture.width, picture.height, tuple(true))


def _distance_m(label: Label, depth_m: Array32 | None) -> float:
    if "distance_m" in label.extras or depth_m is None or label.mask_code is None:
        return float(label.extras.get("distance_m", math.nan))
    read = depth_m[label.mask_code.decode()]
    read = read[read > 0]
    return float(np.median(read)) if read.size else math.nan


def capture_of(picture: LabelledPicture, data: DataSet, color: Pixels) -> Capture | None:
    """Return a picture as RGB-D capture, or None without depth or camera.

    Raises
    ------
    CaptureError
        If the depth picture cannot be read or has the wrong size.
    """
    if picture.depth_file is None or picture.camera is None:
        return None
    path = data.folder / picture.depth_file
    depth_m = depth_to_metres(read_depth(path), picture.depth_unit_m, source=path)
    gravity = picture.extras.get("gravity")
    return Capture(
        color,
        depth_m,
        picture.camera,
        name=Path(picture.file).stem,
        simulated=picture.source == DRAWN,
        source=str(path),
        gravity=None if gravity is None else (gravity[0], gravity[1], gravity[2]),
    )


_LEAST_CONFIDENCE = 0.001
"""Confidence threshold for average precision, which needs the ranking of all detections."""

MOST = 100
"""Maximum number of detections per picture, as in COCO."""


@dataclass(frozen=True, eq=False)
class Networks:
    """Loaded networks.

    Parameters
    ----------
    segment, pose : YoloDetector, optional
        Segmentation and pose network.
    segmenter : NetworkSegmenter, optional
        SAM.
    confidence : float
        Confidence threshold for recall, precision and measurement.
    fruit : FruitLooker, optional
        Looks at each fruit, instead of the pose network.
    ends : FruitLooker, optional
        Orders the keypoints of a pose network that does not.
    models : list of dict
        File, SHA-256 and runtime of each network, for the provenance.
    input_sizes : tuple of int
        Long sides of the detector input, pixels; empty for each network's default.
    """

    segment: YoloDetector | None
    pose: YoloDetector | None
    segmenter: NetworkSegmenter | None
    confidence: float
    models: list[dict[str, Any]] = field(default_factory=list)
    fruit: FruitLooker | None = None
    ends: FruitLooker | None = None
    input_sizes: tuple[int, ...] = ()


def open_networks(
    segment: Path | str | None,
    pose: Path | str | None,
    segmenter: str | None,
    *,
    runtime: str = "auto",
    confidence: float = DEFAULT_CONFIDENCE,
    ranked: bool = True,
    input_sizes: tuple[int, ...] = (),
    as_in_use: bool | None = None,
) -> Networks:
    """Load the networks to evaluate.

    Parameters
    ----------
    segment, pose : Path or str, optional
        ONNX files, or names of the registry; by default its networks in use.
    segmenter : str, optional
        Name of a SAM in the registry.
    runtime : str
        See `open_network`.
    confidence : float
        Confidence threshold.
    ranked : bool
        Also return detections below the threshold, which average precision needs; slower.
    input_sizes : tuple of int
        Long sides of the detector input, see `NetworkLoader`.
    as_in_use : bool, optional
        Whether the networks beside the detector in use look at its detections, as in `detect` and
        `measure`. By default those of a detector of the registry do; a file is evaluated by itself.

    Raises
    ------
    ModelError
        If there is neither of the two, or a file cannot be loaded.
    """
    reported = min(CANDIDATE_CONFIDENCE, pose_floor(confidence))
    loader = NetworkLoader(
        runtime=runtime,
        confidence=_LEAST_CONFIDENCE if ranked else reported,
        full_precision=True,
        most_fruit=MOST,
        input_sizes=input_sizes,
    )
    segment, pose = (
        network or (model.name if (model := loader.registry.default(task)) else None)
        for network, task in ((segment, "segment"), (pose, "pose"))
    )
    if segment is None and pose is None:
        raise ModelError("the package contains no networks", remedy="give one with --seg or --pose")
    beside = isinstance(segment, str) if as_in_use is None else as_in_use
    detector = None if segment is None else loader.yolo(segment)
    points = None if pose is None else loader.yolo(pose)
    sam = None if segmenter is None else loader.segmenter(segmenter)
    looks = beside and loader.registry.looks_closely and not isinstance(pose, Path)
    fruit = loader.fruit_looker() if looks else None
    stem = loader.stem_looker()
    return Networks(detector, points, sam, confidence, loader.models, fruit, stem, input_sizes)


def detect_picture(
    frame: Frame,
    color: Pixels,
    networks: Networks,
    depth_m: Array32 | None = None,
    focal_px: float | None = None,
) -> tuple[Frame, tuple[Instance, ...], dict[str, float]]:
    """Run the networks on one picture.

    Parameters
    ----------
    frame : Frame
        Labels of the picture.
    color : ndarray of uint8, shape (H, W, 3)
        RGB.
    networks : Networks
        Networks to run.
    depth_m : ndarray of float32, shape (H, W), optional
        Depth in metres, for the distance of detections and for occlusion.
    focal_px : float, optional
        Focal length, for the network that looks at each fruit.

    Returns
    -------
    frame : Frame
        Labels and detections.
    kept : tuple of Instance
        Reported instances, best first, with keypoints and the detector's masks.
    seconds : dict of str to float
        Run time of each network.
    """
    seconds: dict[str, float] = {}

    def detect(name: str, network: YoloDetector | None) -> tuple[Instance, ...]:
        if network is None:
            return ()
        start = time.perf_counter()
        detections = network.detect(color)
        seconds[name] = time.perf_counter() - start
        return detections

    segmented, posed = detect("segment", networks.segment), detect("pose", networks.pose)
    confidence = networks.confidence
    if networks.segment is None:
        instances = each_fruit_once(posed, None, depth_m, confidence=confidence)
    else:
        # With a look at each fruit, the pose network has no vote.
        pose = None if networks.fruit else networks.pose
        floor = detector_floor(confidence, votes=pose is not None)
        detectors = Detectors(
            _Known(networks.segment, segmented, floor),
            None if pose is None else _Known(pose, posed, pose_floor(confidence)),
            confidence,
            networks.fruit,
        )
        instances = detectors.find(color, depth_m, focal_px)
    if (
        not networks.fruit
        and networks.segmenter is not None
        and any(fruit.keypoints is not None for fruit in frame.true)
    ):
        instances = _placed(instances, networks.segmenter, color)

    def coded(instances: Sequence[Instance]) -> tuple[Label, ...]:
        if networks.ends is not None:
            instances = PictureLooks(networks.ends, color, depth_m, focal_px).order(instances)
        return tuple(detected_label(instance, depth_m) for instance in instances)

    frame = replace(
        frame,
        segmented=coded(segmented),
        posed=coded(posed),
        kept=coded(instances),
        has_masks=networks.segment is not None and networks.segment.task == "segment",
    )
    return frame, instances, seconds


class _Known(YoloDetector):
    """A network whose detections on the image are known, to be merged as the product does."""

    def __init__(
        self, network: YoloDetector, detections: Sequence[Instance], confidence: float
    ) -> None:
        self._detections, self.confidence, self.looks = detections, confidence, network.looks

    def detect(
        self,
        color_rgb: Pixels,  # noqa: ARG002
        confidence: float | None = None,
    ) -> tuple[Instance, ...]:
        least = self.confidence if confidence is None else confidence
        return tuple(found for found in self._detections if found.confidence > least)


def detect_set(data: DataSet, networks: Networks) -> tuple[Frame, ...]:
    """Run the networks on every picture of a data set, without depth."""
    colors = ((frame_of(p, data, None), read_color(data.path(p))) for p in data.pictures)
    return tuple(detect_picture(*pair, networks)[0] for pair in colors)


def _placed(
    instances: tuple[Instance, ...], segmenter: NetworkSegmenter, color: Pixels
) -> tuple[Instance, ...]:
    """Replace keypoints by those on the axes of SAM's masks, as used for measurement."""
    drawn = place_keypoints(segmenter.segment(color, instances))
    return tuple(
        replace(instance, keypoints=masked.keypoints)
        for instance, masked in zip(instances, drawn, strict=True)
    )
