"""Find the fruit of a picture: a detector, the look at each detection, and a pose network."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.fruit.instance import merge_instances, with_disjoint_masks, with_keypoints
from cucumbervision.fruit.masks import box_ious
from cucumbervision.networks.confidence import CANDIDATE_CONFIDENCE, DEFAULT_CONFIDENCE
from cucumbervision.networks.yolo import SAME_IOU

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from cucumbervision.fruit.instance import Instance
    from cucumbervision.networks.looks import FruitLooker
    from cucumbervision.networks.yolo import YoloDetector


class Detectors:
    """A detector and the network beside it that gives keypoints, with their detections merged.

    Parameters
    ----------
    detector : YoloDetector
        Finds the fruit. Classes are ignored when merging: a fruit of two classes is one.
    pose : YoloDetector, optional
        Gives the keypoints, and votes on the confidence (`with_pose_votes`).
    confidence : float
        Threshold for a fruit.
    fruit : FruitLooker, optional
        Gives the outlines and the keypoints of what is found.
    quick : bool
        Whether `fruit` looks once, and only at what the detector is sure of.
    """

    def __init__(
        self,
        detector: YoloDetector,
        pose: YoloDetector | None = None,
        confidence: float = DEFAULT_CONFIDENCE,
        *,
        fruit: FruitLooker | None = None,
        quick: bool = False,
    ) -> None:
        self._detector, self._pose, self._confidence = detector, pose, confidence
        self._fruit, self._quick = fruit, quick

    @property
    def labels(self) -> tuple[str, ...]:
        """The detector's class names, in its order; empty if it has none."""
        return tuple(name for _, name in sorted(self._detector.names.items()))

    @property
    def gives_keypoints(self) -> bool:
        """Whether fruit may come with keypoints."""
        from_detector = self._detector.task == "pose"
        return from_detector or self._pose is not None or self._fruit is not None

    def find(
        self,
        color_rgb: NDArray[np.uint8],
        depth_m: NDArray[np.float32] | None = None,
        focal_px: float | None = None,
    ) -> tuple[Instance, ...]:
        """Find the fruit of one picture, without duplicates.

        Parameters
        ----------
        color_rgb : ndarray of uint8, shape (H, W, 3)
            The picture.
        depth_m : ndarray of float32, shape (H, W), optional
            Metres, aligned to colour; separates overlapping fruit, and is shown to the network that
            looks at each.
        focal_px : float, optional
            Focal length of the colour camera, pixels; without it depth is not shown.

        Returns
        -------
        tuple of Instance
            Best first, with masks and keypoints.
        """
        detector, pose = self._detector, self._pose
        looks, least_confidence = None, None
        if self._fruit is not None:
            looks = self._fruit.on(color_rgb, depth_m, focal_px, once=self._quick)
        if looks is not None and not self._quick:
            least_confidence = min(CANDIDATE_CONFIDENCE, detector.confidence)
        detections = detector.detect(color_rgb, least_confidence)
        posed = pose.detect(color_rgb) if pose is not None and detections else None
        fruit = each_fruit_once(
            detections,
            posed,
            depth_m,
            confidence=self._confidence,
            looks=detector.looks,
            look=None if looks is None else looks.rescore,
        )
        return fruit if looks is None else looks.refine(fruit)


def each_fruit_once(
    detected: Sequence[Instance],
    posed: Sequence[Instance] | None,
    depth_m: NDArray[np.float32] | None = None,
    *,
    confidence: float = DEFAULT_CONFIDENCE,
    looks: int = 1,
    look: Callable[[Sequence[Instance]], Sequence[Instance]] | None = None,
) -> tuple[Instance, ...]:
    """Merge a detector's and a pose network's detections of one picture.

    Parameters
    ----------
    detected : sequence of Instance
        The detector's detections.
    posed : sequence of Instance, optional
        The pose network's detections; None without a pose network.
    depth_m : ndarray of float32, shape (H, W), optional
        Metres, aligned to colour: separates overlapping masks.
    confidence : float
        Threshold for a fruit after the vote; poses above it are matched first.
    looks : int
        As for `with_pose_votes`.
    look : callable, optional
        Rescores the detections, before the pose network.

    Returns
    -------
    tuple of Instance
        One instance per fruit, best first; masks do not overlap.
    """
    voted = detected if look is None else look(detected)
    voted = voted if posed is None else with_pose_votes(voted, posed, looks)
    voted = sorted(voted, key=lambda detection: -detection.confidence)
    fruit = merge_instances([detection for detection in voted if detection.confidence > confidence])
    return with_disjoint_masks(
        with_keypoints(fruit, merge_instances(posed or ()), sure=confidence), depth_m
    )


def with_pose_votes(
    detected: Sequence[Instance], posed: Sequence[Instance], looks: int = 1
) -> tuple[Instance, ...]:
    """Return detections with the mean confidence of detector and pose network.

    The pose network was trained on the same fruit but makes other mistakes: objects found only by
    the detector are rarely fruit.

    Parameters
    ----------
    detected : sequence of Instance
        Detections of the detector.
    posed : sequence of Instance
        The pose network's detections. Each votes for at most one detection, with a box IoU of more
        than 0.5.
    looks : int
        Number of the detector's input sizes. Every input size and the pose network have the same
        weight; a miss counts 0 (as in `merge_sizes`).

    Returns
    -------
    tuple of Instance
        Best first.

    Examples
    --------
    >>> from cucumbervision.fruit.instance import Instance
    >>> confirmed, alone = (Instance(np.array([x, 0.0, x + 9, 40]), 0.6) for x in (0, 50))
    >>> pose = Instance(np.array([0.0, 0, 9, 38]), 0.9)
    >>> voted = with_pose_votes([alone, confirmed], [pose], looks=2)
    >>> [round(detection.confidence, 2) for detection in voted]
    [0.7, 0.4]
    """
    free = list(posed)
    voted = []
    for detection in sorted(detected, key=lambda detection: -detection.confidence):
        ious = box_ious(detection.box[None], np.array([pose.box for pose in free]).reshape(-1, 4))[
            0
        ]
        agrees = ious.size > 0 and ious.max() > SAME_IOU
        vote = free.pop(int(ious.argmax())).confidence if agrees else 0.0
        voted.append(
            replace(detection, confidence=(looks * detection.confidence + vote) / (looks + 1))
        )
    return tuple(sorted(voted, key=lambda detection: -detection.confidence))
