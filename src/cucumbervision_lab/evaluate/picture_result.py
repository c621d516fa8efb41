"""Run the networks on test pictures as `detect` and `measure` do."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cucumbervision.capture.pictures import read_color
from cucumbervision.networks.confidence import (
    CANDIDATE_CONFIDENCE,
    DEFAULT_CONFIDENCE,
    detector_floor,
    pose_floor,
)
from cucumbervision.networks.find import each_fruit_once
from cucumbervision.networks.keypoint_axis import place_keypoints
from cucumbervision.networks.loaded import NetworkLoader
from cucumbervision_lab.arrays import Array32, Pixels
from cucumbervision_lab.evaluate import pictures
from cucumbervision_lab.evaluate.outcomes import match_detections

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from cucumbervision.fruit.instance import Instance
    from cucumbervision.networks.loaded import NetworkSegmenter
    from cucumbervision.networks.looks import FruitLooker
    from cucumbervision.networks.yolo import YoloDetector
    from cucumbervision_lab.data.labels import DataSet, Label


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
    """

    segment: YoloDetector | None
    pose: YoloDetector | None
    segmenter: NetworkSegmenter | None
    confidence: float
    models: list[dict[str, Any]] = field(default_factory=list)
    fruit: FruitLooker | None = None
    ends: FruitLooker | None = None


@dataclass(frozen=True, eq=False)
class PictureResult:
    """Detections on one picture.

    Parameters
    ----------
    frame : Frame
        Labels and detections.
    kept : tuple of Instance
        Reported instances, best first, with keypoints and the detector's masks.
    seconds : dict of str to float
        Run time of each network.
    """

    frame: pictures.Frame
    kept: tuple[Instance, ...]
    seconds: dict[str, float]


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
        ONNX files, or names of the registry.
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
        If a file cannot be loaded.
    """
    reported = min(CANDIDATE_CONFIDENCE, pose_floor(confidence))
    loader = NetworkLoader(
        runtime=runtime,
        confidence=_LEAST_CONFIDENCE if ranked else reported,
        full_precision=True,
        most_fruit=MOST,
        input_sizes=input_sizes,
    )
    beside = isinstance(segment, str) if as_in_use is None else as_in_use
    detector = None if segment is None else loader.yolo(segment)
    points = None if pose is None else loader.yolo(pose)
    sam = None if segmenter is None else loader.segmenter(segmenter)
    looks = beside and loader.registry.looks_closely and not isinstance(pose, Path)
    fruit = loader.fruit_looker() if looks else None
    return Networks(detector, points, sam, confidence, loader.models, fruit, loader.stem_looker())


def detect_picture(
    frame: pictures.Frame,
    color: Pixels,
    networks: Networks,
    depth_m: Array32 | None = None,
    focal_px: float | None = None,
) -> PictureResult:
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
    """
    seconds: dict[str, float] = {}

    def detect(name: str, network: YoloDetector | None) -> tuple[Instance, ...]:
        if network is None:
            return ()
        start = time.perf_counter()
        detections = network.detect(color)
        seconds[name] = time.perf_counter() - start
        return detections

    looks = None if networks.fruit is None else networks.fruit.on(color, depth_m, focal_px)
    segmented, posed = detect("segment", networks.segment), detect("pose", networks.pose)
    instances = merge_detections(
        segmented if networks.segment else None,
        posed if networks.pose else None,
        networks.confidence,
        depth_m,
        looks=networks.segment.looks if networks.segment else 1,
        look=None if looks is None else looks.rescore,
    )
    if looks is not None:
        instances = looks.refine(instances)
    elif networks.segmenter is not None and any(
        fruit.keypoints is not None for fruit in frame.true
    ):
        instances = _placed(instances, networks.segmenter, color)

    def coded(instances: Sequence[Instance]) -> tuple[Label, ...]:
        if networks.ends is not None:
            instances = networks.ends.on(color, depth_m, focal_px).order(instances)
        return tuple(pictures.detected_label(instance, depth_m) for instance in instances)

    frame = replace(
        frame,
        segmented=coded(segmented),
        posed=coded(posed),
        kept=coded(instances),
        has_masks=networks.segment is not None and networks.segment.task == "segment",
    )
    return PictureResult(frame, instances, seconds)


def detect_set(data: DataSet, networks: Networks) -> list[pictures.Frame]:
    """Run the networks on every picture of a data set, without depth."""
    return [
        detect_picture(
            pictures.frame_of(picture, data, None), read_color(data.path(picture)), networks
        ).frame
        for picture in data.pictures
    ]


def _placed(
    instances: tuple[Instance, ...], segmenter: NetworkSegmenter, color: Pixels
) -> tuple[Instance, ...]:
    """Replace keypoints by those on the axes of SAM's masks, as used for measurement."""
    drawn = place_keypoints(segmenter.segment(color, instances))
    return tuple(
        replace(instance, keypoints=masked.keypoints)
        for instance, masked in zip(instances, drawn, strict=True)
    )


def merge_detections(
    segmented: Sequence[Instance] | None,
    posed: Sequence[Instance] | None,
    confidence: float,
    depth_m: Array32 | None = None,
    *,
    looks: int = 1,
    look: Callable[[Sequence[Instance]], Sequence[Instance]] | None = None,
) -> tuple[Instance, ...]:
    """Merge the detections of both networks as the product does, each fruit once with keypoints.

    Parameters
    ----------
    segmented : sequence of Instance, optional
        Detections of the segmentation network; without them, those of the pose network are used.
    posed : sequence of Instance, optional
        Detections of the pose network.
    confidence : float
        Confidence threshold.
    depth_m : ndarray of float32, shape (H, W), optional
        Metres, aligned to colour.
    looks : int
        Number of input sizes at which the detector was run.
    look : callable, optional
        See `each_fruit_once`; with a look the pose network has no vote.
    """
    if segmented is None or (posed is None and look is None):
        candidates = posed if segmented is None else segmented
        return each_fruit_once(candidates or (), None, depth_m, confidence=confidence)
    floor = detector_floor(confidence, votes=True)
    if look is not None:
        floor = min(floor, CANDIDATE_CONFIDENCE)
    detected = [instance for instance in segmented if instance.confidence > floor]
    poses = None
    if look is None:
        sure = pose_floor(confidence)
        poses = [instance for instance in posed or () if instance.confidence > sure]
    return each_fruit_once(detected, poses, depth_m, confidence=confidence, looks=looks, look=look)


def found_by_fruit(result: PictureResult, confidence: float) -> dict[int, Instance]:
    """Return the reported instance of each detected fruit, by its index in `Frame.true`."""
    matches, _, required = match_detections(result.frame, confidence, pictures.Stage.KEPT)
    return {required[t]: result.kept[s] for t, s in matches.pairs}
