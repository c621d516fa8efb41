"""Learn depth's vote on detections, from drawn scenes and the shipped detector."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit

from cucumbervision.capture.pictures import read_color
from cucumbervision.perception.boxes import box_ious, share_inside
from cucumbervision.perception.depth_vote import (
    AGAINST,
    CANDIDATE_CONFIDENCE,
    FEATURES,
    DepthShape,
    DepthVote,
    depth_shape,
)
from cucumbervision.perception.networks import NetworkLoader
from cucumbervision_lab.datasets.labels import ticked
from cucumbervision_lab.detection.outcomes import match_frame
from cucumbervision_lab.detection.pictures import capture_of, frame_of, read_held_out

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from cucumbervision.perception.yolo import YoloDetector
    from cucumbervision_lab.datasets.labels import DataSet, LabelledPicture
    from cucumbervision_lab.detection.pictures import Frame

_ON_FRUIT = 0.3  # share of a detection on any fruit from which it is not called wrong
_RIDGE = 0.5  # how firmly a weight is held to what is expected where few detections tell
_EXPECTED = -2.0  # of `AGAINST`
_FOLDS = 5


@dataclass(frozen=True)
class Candidate:
    """A detection that depth can judge.

    Parameters
    ----------
    scene : int
        Number of its picture.
    confidence : float
        The detector's, 0 to 1.
    shape : DepthShape
        What depth shows of it.
    is_fruit : bool
        Whether it is a fruit.
    """

    scene: int
    confidence: float
    shape: DepthShape
    is_fruit: bool


@dataclass(frozen=True)
class DepthVoteFit:
    """A vote that was learnt, and what it is worth.

    Parameters
    ----------
    vote : DepthVote
        Learnt from all candidates.
    fruit, others : int
        Candidates that are a fruit, and those that are none.
    log_loss, log_loss_without : float
        Mean negative log-likelihood of candidates in scenes left out, with depth, and by the
        detector's confidence alone.
    """

    vote: DepthVote
    fruit: int
    others: int
    log_loss: float
    log_loss_without: float


def learn_depth_vote(
    folder: Path, file: Path, report: Callable[[int], None] | None = None
) -> DepthVoteFit:
    """Learn the vote from a set by `synth` with depth, and write it.

    Parameters
    ----------
    folder : Path
        The set.
    file : Path
        JSON of the vote, as `read_depth_vote` reads it.
    report : callable, optional
        Called with how many pictures were just finished.

    Raises
    ------
    DataSetError
        If the set cannot be read.
    ModelError
        If the detector cannot be loaded.
    """
    held = read_held_out(folder, "all")
    loader = NetworkLoader(confidence=CANDIDATE_CONFIDENCE)
    detector = loader.yolo(loader.registry.get("cucumber-seg").name)
    found = (
        _candidates(scene, picture, held.data, detector)
        for scene, picture in enumerate(held.pictures)
    )
    fit = fit_depth_vote([one for some in ticked(found, report) for one in some])
    file.write_text(json.dumps(asdict(fit.vote), indent=1) + "\n", encoding="utf-8")
    return fit


def fit_depth_vote(candidates: Sequence[Candidate]) -> DepthVoteFit:
    """Fit the vote; every fifth scene in turn is left out to judge it."""
    features = np.array([one.shape.features(one.confidence) for one in candidates])
    right = np.array([one.is_fruit for one in candidates])
    fold = np.array([one.scene for one in candidates]) % _FOLDS
    by_confidence = features[:, : FEATURES.index("logit_confidence") + 1]
    return DepthVoteFit(
        DepthVote(tuple(_weights(features, right).round(4).tolist()), len(right)),
        fruit=int(right.sum()),
        others=int((~right).sum()),
        log_loss=_left_out_loss(features, right, fold),
        log_loss_without=_left_out_loss(by_confidence, right, fold),
    )


def _weights(features: NDArray[np.float64], right: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Fit a logistic regression with a normal prior on every weight but the constant."""
    names = FEATURES[: features.shape[1]]
    expected = np.array([_EXPECTED if name in AGAINST else 0.0 for name in names])

    def loss(weights: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        scores = features @ weights
        slope = features.T @ (expit(scores) - right)
        ridge = np.r_[0.0, (weights - expected)[1:]]
        value = np.logaddexp(0, scores).sum() - scores[right].sum() + _RIDGE * ridge @ ridge
        return float(value), slope + 2 * _RIDGE * ridge

    bounds = [(None, 0.0 if name in AGAINST else None) for name in names]
    start = np.zeros(len(names))
    found = minimize(loss, start, jac=True, method="L-BFGS-B", bounds=bounds)
    return np.asarray(found.x)


def _left_out_loss(
    features: NDArray[np.float64], right: NDArray[np.bool_], fold: NDArray[np.intp]
) -> float:
    losses = []
    for k in np.unique(fold):
        out = fold == k
        scores = features[out] @ _weights(features[~out], right[~out])
        losses.append(np.logaddexp(0, np.where(right[out], -scores, scores)))
    return float(np.concatenate(losses).mean())


def _candidates(
    scene: int, picture: LabelledPicture, data: DataSet, detector: YoloDetector
) -> list[Candidate]:
    color = read_color(data.path(picture))
    capture = capture_of(picture, data, color)
    if capture is None:
        return []
    found = detector.detect(color)
    candidates = []
    judged = _judged(frame_of(picture, data, None), np.array([one.box for one in found]))
    for one, is_fruit in zip(found, judged, strict=True):
        if is_fruit is None or one.detector_mask is None:
            continue
        shape = depth_shape(one.detector_mask, capture.depth_m, capture.intrinsics.fx_px)
        if shape is not None:
            candidates.append(Candidate(scene, one.confidence, shape, is_fruit))
    return candidates


def _judged(frame: Frame, boxes: NDArray[np.float64]) -> list[bool | None]:
    """Return which boxes are a fruit; None for a second box of a fruit, or a part of one."""
    boxes = boxes.reshape(-1, 4)
    hits = {found for _, found in match_frame(frame, list(boxes))[0].pairs}
    true = np.array([one.box for one in frame.true]).reshape(-1, 4)
    on_fruit = np.maximum(box_ious(boxes, true).max(axis=1, initial=0.0), share_inside(boxes, true))
    return [
        True if k in hits else None if on_fruit[k] > _ON_FRUIT else False for k in range(len(boxes))
    ]
