"""Rescore detections by depth: whether they have the size and surface of a cucumber.

On plants, the detector is right far more often than its low confidences indicate, and most false
positives have another size or are leaves. A logistic regression on the detector's confidence and on
depth features inside and around the mask gives the probability of a cucumber.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from pydantic import TypeAdapter
from scipy.special import expit, logit

from cucumbervision.errors import ModelError, wrap_reader_errors
from cucumbervision.files import read_json
from cucumbervision.geometry.pixels import quick_median
from cucumbervision.instances.masks import mask_window
from cucumbervision.perception.confidence import DEFAULT_CONFIDENCE

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from cucumbervision.instances.instance import Instance

FEATURES = (
    "constant",
    "logit_confidence",
    "wider",
    "shorter",
    "longer",
    "far_share",
    "relief",
)
"""Features in the order of the weights. Wider, shorter and longer are logarithms of how far a size
exceeds the usual range. There is no 'narrower', because partly occluded fruit may look narrow."""

AGAINST = FEATURES[2:]
"""Features whose weights must not be positive."""

CANDIDATE_CONFIDENCE = 0.02
"""Minimum confidence of a detection that depth may raise above the threshold."""

_SHIPPED = Path(__file__).with_name("depth_vote.json")
_WIDEST_M, _SHORTEST_M, _LONGEST_M = 0.04, 0.10, 0.30  # usual sizes
_FEWEST_READINGS, _FEWEST_SHARE = 30, 0.05
_BODY_M = 0.06  # depth further than this from the median belongs to something else
_SLICES = 12  # along the mask, so that a bent fruit is straight within each
_CORE_WIDTH = 0.35  # of the half width: pixels that give a slice's depth
_NEARLY_ALL = 0.95  # quantile of the distances from a slice's middle: half of its width
_MOST_RELIEF = 2.0
_REPORTED_PROBABILITY = 0.75  # from which a detection is reported by default


@dataclass(frozen=True)
class DepthShape:
    """Size and surface of a masked object from depth.

    Parameters
    ----------
    width_m, length_m : float
        Mean width and longest side of the mask at its median depth, metres.
    far_share : float
        Share of its readings more than 6 cm from the median.
    relief : float
        Standard deviation of depth about the middle line, in half widths; at most 2, and 2 if
        unknown.
    """

    width_m: float
    length_m: float
    far_share: float
    relief: float

    def features(self, confidence: float) -> NDArray[np.float64]:
        """Return `FEATURES` of a detection with that confidence."""
        width_m, length_m = max(self.width_m, 1e-3), max(self.length_m, 1e-3)
        outside = (width_m / _WIDEST_M, _SHORTEST_M / length_m, length_m / _LONGEST_M)
        sizes = np.log(np.maximum(outside, 1.0))
        sure = logit(np.clip(confidence, 0.01, 0.99))
        return np.array([1.0, sure, *sizes, self.far_share, self.relief])


@dataclass(frozen=True)
class DepthVote:
    """A logistic regression of `FEATURES`.

    Parameters
    ----------
    weights : tuple of float
        One weight for each of `FEATURES`.
    detections : int
        Number of detections used for fitting.
    """

    weights: tuple[float, ...]
    detections: int

    def probability(self, confidence: float, shape: DepthShape) -> float:
        """Return the probability that a detection is a cucumber, 0 to 1."""
        return float(expit(shape.features(confidence) @ np.array(self.weights)))


def depth_shape(
    mask: NDArray[np.bool_], depth_m: NDArray[np.float32], focal_px: float
) -> DepthShape | None:
    """Compute the size and surface of a masked object.

    Parameters
    ----------
    mask : ndarray of bool, shape (H, W)
        A detection's mask.
    depth_m : ndarray of float32, shape (H, W)
        Metres, aligned; 0 where unknown.
    focal_px : float
        The colour camera's focal length, pixels.

    Returns
    -------
    DepthShape or None
        None with fewer than 30 readings, or readings for less than a twentieth of the mask.

    Examples
    --------
    >>> mask, depth = np.zeros((200, 300), bool), np.full((200, 300), 0.5, np.float32)
    >>> mask[90:110, 50:250] = True
    >>> shape = depth_shape(mask, depth, focal_px=500.0)
    >>> round(shape.width_m, 3), round(shape.length_m, 2), shape.relief
    (0.02, 0.2, 0.0)
    >>> depth_shape(mask, 0 * depth, focal_px=500.0) is None
    True
    """
    window = mask_window(mask)
    if window is None:
        return None
    rows, columns = np.nonzero(mask[window])
    readings = depth_m[window][rows, columns]
    is_read = readings > 0
    if is_read.sum() < max(_FEWEST_READINGS, _FEWEST_SHARE * len(rows)):
        return None
    middle_m = float(np.median(readings[is_read]))
    pixels = np.column_stack([columns, rows])
    ends = np.flatnonzero(np.diff(rows, prepend=-1, append=-1))  # of the rows, which hold the hull
    hull = pixels[np.concatenate([ends[:-1], ends[1:] - 1])].astype(np.float32)
    length_px = max(*cv2.minAreaRect(hull)[1], 1)
    width_px = len(rows) / length_px
    body = is_read & (np.abs(readings - middle_m) < _BODY_M)
    return DepthShape(
        width_m=width_px * middle_m / focal_px,
        length_m=length_px * middle_m / focal_px,
        far_share=float(1 - body.sum() / is_read.sum()),
        relief=_relief(
            pixels[body],
            readings[body],
            width_px / 2 * middle_m / focal_px,
        ),
    )


def _relief(pixels: NDArray[np.intp], depth_m: NDArray[np.float32], half_width_m: float) -> float:
    """Return the deviation of depth from the middle line's, in half widths."""
    offset = pixels - pixels.mean(0)
    across, along = (np.linalg.eigh(offset.T @ offset)[1].T @ offset.T)[:2]
    slices = ((along - along.min()) / (np.ptp(along) + 1e-9) * _SLICES).astype(int)
    slices = np.minimum(slices, _SLICES - 1).astype(np.uint8)
    order = np.argsort(slices, kind="stable")  # a radix sort; a mask for each slice takes longer
    edges = np.searchsorted(slices[order], np.arange(1, _SLICES))
    from_line = []
    for side, readings in zip(
        np.split(across[order], edges), np.split(depth_m[order], edges), strict=True
    ):
        if not side.size:
            continue
        side = np.abs(side - quick_median(side))
        core = readings[side <= _CORE_WIDTH * max(_half_width_px(side), 2.0)]
        if core.size > 4:
            from_line.append(readings - quick_median(core))
    if not from_line:
        return _MOST_RELIEF
    return float(min(np.std(np.concatenate(from_line)) / half_width_m, _MOST_RELIEF))


def _half_width_px(side_px: NDArray[np.float64]) -> float:
    """Return the 95 % quantile, interpolated as `numpy.percentile` does it."""
    place = _NEARLY_ALL * (len(side_px) - 1)
    below = min(int(place), len(side_px) - 2) if len(side_px) > 1 else 0
    above = min(below + 1, len(side_px) - 1)
    nearest = np.partition(side_px, (below, above))
    return float(nearest[above] - (nearest[above] - nearest[below]) * (above - place))


def with_depth_votes(
    detections: Sequence[Instance], depth_m: NDArray[np.float32], focal_px: float
) -> tuple[Instance | None, ...]:
    """Return detections with confidences rescored by depth.

    The probability p of a cucumber becomes a confidence on the detector's own scale, where the
    default threshold stands for p = 0.75: logit(confidence) = logit(p) - logit(0.75) + logit(0.2).

    Parameters
    ----------
    detections : sequence of Instance
        Detections of the shipped detector, with confidences and masks.
    depth_m : ndarray of float32, shape (H, W)
        Metres, aligned; 0 where unknown.
    focal_px : float
        The colour camera's focal length, pixels.

    Returns
    -------
    tuple of Instance or None
        In the same order; None for those without a mask or with too little depth.
    """
    vote = _shipped_vote()
    shift = logit(DEFAULT_CONFIDENCE) - logit(_REPORTED_PROBABILITY)
    voted: list[Instance | None] = []
    for detection in detections:
        mask = detection.detector_mask
        shape = None if mask is None else depth_shape(mask, depth_m, focal_px)
        if shape is None:
            voted.append(None)
            continue
        likely = np.clip(vote.probability(detection.confidence, shape), 1e-6, 1 - 1e-6)
        confidence = expit(logit(likely) + shift)
        voted.append(replace(detection, confidence=float(confidence)))
    return tuple(voted)


def read_depth_vote(file: Path) -> DepthVote:
    """Read a vote written by `cucumbervision train depth-vote`.

    Raises
    ------
    ModelError
        If the file is damaged.
    """
    with wrap_reader_errors(file, ModelError):
        vote = TypeAdapter(DepthVote).validate_python(read_json(file, ModelError))
    if len(vote.weights) != len(FEATURES):
        raise ModelError(
            f"it has {len(vote.weights)} weights, not {len(FEATURES)}",
            source=file,
            remedy="install the package again",
        )
    return vote


@lru_cache
def _shipped_vote() -> DepthVote:
    return read_depth_vote(_SHIPPED)
