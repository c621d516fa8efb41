"""The networks run on a test's pictures as `detect` and `measure` run them."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from cucumbervision.perception.confidence import DEFAULT_CONFIDENCE, detector_floor, pose_floor
from cucumbervision.perception.depth_vote import CANDIDATE_CONFIDENCE
from cucumbervision.perception.keypoint_axis import place_keypoints
from cucumbervision.perception.networks import NetworkLoader, each_fruit_once
from cucumbervision_lab.detection.outcomes import matches_of
from cucumbervision_lab.detection.pictures import FoundFruit, Frame, Stage, found_fruit_of

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    import numpy as np
    from numpy.typing import NDArray

    from cucumbervision.perception.instances import Instance
    from cucumbervision.perception.networks import Segmenter
    from cucumbervision.perception.yolo import YoloDetector


_FLOOR = 0.001
"""Least confidence for average precision, which judges the ranking of all detections."""

MOST = 100
"""Detections a picture that are judged, best first, as COCO does."""


@dataclass(frozen=True, eq=False)
class Networks:
    """The networks, loaded.

    Parameters
    ----------
    segment, pose : YoloDetector, optional
        The detectors.
    segmenter : Segmenter, optional
        SAM.
    confidence : float
        At which recall and precision are judged and fruit are measured.
    models : list of dict
        File, SHA-256 and runtime of each, for the provenance.
    """

    segment: YoloDetector | None
    pose: YoloDetector | None
    segmenter: Segmenter | None
    confidence: float
    models: list[dict[str, Any]] = field(default_factory=list)


@dataclass(frozen=True, eq=False)
class PictureResult:
    """Result of the networks on one picture.

    Parameters
    ----------
    frame : Frame
        Truth and detections.
    kept : tuple of Instance
        What is reported at the confidence, best first, with keypoints and the detector's masks.
    seconds : dict of str to float
        How long each network took.
    """

    frame: Frame
    kept: tuple[Instance, ...]
    seconds: dict[str, float]


def open_networks(
    segment: Path | None,
    pose: Path | None,
    segmenter: str | None,
    *,
    runtime: str = "auto",
    confidence: float = DEFAULT_CONFIDENCE,
    ranked: bool = True,
    input_sizes: tuple[int, ...] = (),
) -> Networks:
    """Load the networks.

    Parameters
    ----------
    segment, pose : Path, optional
        ONNX files.
    segmenter : str, optional
        A SAM of the registry.
    runtime : str
        As in `open_network`.
    confidence : float
        At which detections count.
    ranked : bool
        Whether average precision is asked for, which judges also what is not reported. Masks of
        so many detections take long.
    input_sizes : tuple of int
        Long sides that the detectors see, as in `NetworkLoader`.

    Raises
    ------
    ModelError
        If a file cannot be loaded.
    """
    reported = min(CANDIDATE_CONFIDENCE, pose_floor(confidence))
    loader = NetworkLoader(
        runtime=runtime,
        confidence=_FLOOR if ranked else reported,
        full_precision=True,
        most=MOST,
        input_sizes=input_sizes,
    )
    detector, points = (None if path is None else loader.yolo(path) for path in (segment, pose))
    sam = None if segmenter is None else loader.segmenter(segmenter)
    return Networks(detector, points, sam, confidence, loader.models)


def detect_picture(
    frame: Frame,
    color: NDArray[np.uint8],
    networks: Networks,
    depth_m: NDArray[np.float32] | None = None,
    focal_px: float | None = None,
) -> PictureResult:
    """Run the detectors on one picture.

    Parameters
    ----------
    frame : Frame
        Its truth.
    color : ndarray of uint8, shape (H, W, 3)
        RGB.
    networks : Networks
        The networks.
    depth_m : ndarray of float32, shape (H, W), optional
        Tells how far away each detection is, and what lies in front of it.
    focal_px : float, optional
        With it, depth votes (`each_fruit_once`).
    """
    seconds: dict[str, float] = {}

    def detect(name: str, network: YoloDetector | None) -> tuple[Instance, ...]:
        if network is None:
            return ()
        start = time.perf_counter()
        found = network.detect(color)
        seconds[name] = time.perf_counter() - start
        return found

    segmented, posed = detect("segment", networks.segment), detect("pose", networks.pose)
    kept = shipped(
        segmented if networks.segment else None,
        posed if networks.pose else None,
        networks.confidence,
        depth_m,
        looks=networks.segment.looks if networks.segment else 1,
        focal_px=focal_px,
    )
    if networks.segmenter is not None and any(one.keypoints is not None for one in frame.true):
        kept = _placed(kept, networks.segmenter, color)

    def coded(found: Sequence[Instance]) -> tuple[FoundFruit, ...]:
        return tuple(found_fruit_of(one, depth_m) for one in found)

    frame = replace(
        frame,
        segmented=coded(segmented),
        posed=coded(posed),
        kept=coded(kept),
        has_masks=networks.segment is not None and networks.segment.task == "segment",
    )
    return PictureResult(frame, kept, seconds)


def _placed(
    kept: tuple[Instance, ...], segmenter: Segmenter, color: NDArray[np.uint8]
) -> tuple[Instance, ...]:
    """Return the keypoints that a measurement gets: on the axes of SAM's masks."""
    drawn = place_keypoints(segmenter.segment(color, kept))
    return tuple(
        replace(one, keypoints=masked.keypoints) for one, masked in zip(kept, drawn, strict=True)
    )


def shipped(
    segmented: Sequence[Instance] | None,
    posed: Sequence[Instance] | None,
    confidence: float,
    depth_m: NDArray[np.float32] | None = None,
    *,
    looks: int = 1,
    focal_px: float | None = None,
) -> tuple[Instance, ...]:
    """Return what a user gets of two networks' detections: each fruit once, with keypoints.

    Parameters
    ----------
    segmented : sequence of Instance, optional
        Of the detector; without one the pose network's own are taken.
    posed : sequence of Instance, optional
        Of the pose network; None without one.
    confidence : float
        A score must exceed it.
    depth_m : ndarray of float32, shape (H, W), optional
        Metres, aligned to colour.
    looks : int
        At how many sizes the detector has looked.
    focal_px : float, optional
        As for `each_fruit_once`.
    """
    if segmented is None or posed is None:
        found = posed if segmented is None else segmented
        return each_fruit_once(found or (), None, depth_m, confidence=confidence)
    least = detector_floor(confidence, votes=True)
    if focal_px is not None:
        least = min(least, CANDIDATE_CONFIDENCE)
    detected = [one for one in segmented if one.confidence > least]
    poses = [one for one in posed if one.confidence > pose_floor(confidence)]
    return each_fruit_once(
        detected,
        poses,
        depth_m,
        confidence=confidence,
        looks=looks,
        focal_px=focal_px,
    )


def found_by_fruit(result: PictureResult, confidence: float) -> dict[int, Instance]:
    """Return what was reported of each true fruit, by its place in `Frame.true`."""
    matches, _, required = matches_of(result.frame, confidence, Stage.KEPT)
    return {required[t]: result.kept[s] for t, s in matches.pairs}
