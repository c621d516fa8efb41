"""Fit the depth vote on synthetic scenes with the packaged detector."""

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
from cucumbervision_lab.detection.outcomes import match_fruit
from cucumbervision_lab.detection.pictures import capture_of, frame_of, read_held_out

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from cucumbervision.perception.yolo import YoloDetector
    from cucumbervision_lab.datasets.labels import DataSet, LabelledPicture
    from cucumbervision_lab.detection.pictures import Frame

_AMBIGUOUS_OVERLAP = 0.3  # unmatched detections that overlap a fruit by more are not negatives
_RIDGE = 0.5  # strength of the prior on the weights
_PRIOR_MEAN = -2.0  # of the weights of `AGAINST`
_FOLDS = 5


@dataclass(frozen=True)
class Candidate:
    """A detection with depth features.

    Parameters
    ----------
    scene : int
        Index of the picture.
    confidence : float
        Confidence of the detector, 0 to 1.
    shape : DepthShape
        Depth features.
    is_fruit : bool
        Whether the detection is a true positive.
    """

    scene: int
    confidence: float
    shape: DepthShape
    is_fruit: bool


@dataclass(frozen=True)
class DepthVoteFit:
    """A fitted vote with its cross-validated loss.

    Parameters
    ----------
    vote : DepthVote
        Vote fitted to all candidates.
    fruit, others : int
        Number of true and of false positives.
    log_loss, log_loss_without : float
        Mean negative log-likelihood on held-out scenes with depth, and with confidence only.
    """

    vote: DepthVote
    fruit: int
    others: int
    log_loss: float
    log_loss_without: float


def learn_depth_vote(
    folder: Path, file: Path, report: Callable[[int], None] | None = None
) -> DepthVoteFit:
    """Fit the depth vote on a synthetic set, and write it.

    Parameters
    ----------
    folder : Path
        Set written by `synth` with depth.
    file : Path
        JSON file for `read_depth_vote`.
    report : callable, optional
        Called with 1 after each picture.

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
    """Fit the depth vote, with five-fold cross-validation by scene."""
    features = np.array([one.shape.features(one.confidence) for one in candidates])
    right = np.array([one.is_fruit for one in candidates])
    fold = np.array([one.scene for one in candidates]) % _FOLDS
    by_confidence = features[:, : FEATURES.index("logit_confidence") + 1]
    return DepthVoteFit(
        DepthVote(tuple(_weights(features, right).round(4).tolist()), len(right)),
        fruit=int(right.sum()),
        others=int((~right).sum()),
        log_loss=_cross_validated_loss(features, right, fold),
        log_loss_without=_cross_validated_loss(by_confidence, right, fold),
    )


def _weights(features: NDArray[np.float64], right: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Fit a logistic regression with a normal prior on all weights except the constant."""
    names = FEATURES[: features.shape[1]]
    expected = np.array([_PRIOR_MEAN if name in AGAINST else 0.0 for name in names])

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


def _cross_validated_loss(
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
    judged = _true_positives(frame_of(picture, data, None), np.array([one.box for one in found]))
    for one, is_fruit in zip(found, judged, strict=True):
        if is_fruit is None or one.detector_mask is None:
            continue
        shape = depth_shape(one.detector_mask, capture.depth_m, capture.intrinsics.fx_px)
        if shape is not None:
            candidates.append(Candidate(scene, one.confidence, shape, is_fruit))
    return candidates


def _true_positives(frame: Frame, boxes: NDArray[np.float64]) -> list[bool | None]:
    """Return whether each box is a true positive; None for duplicates and parts of a fruit."""
    boxes = boxes.reshape(-1, 4)
    hits = {found for _, found in match_fruit(frame, list(boxes))[0].pairs}
    true = np.array([one.box for one in frame.true]).reshape(-1, 4)
    on_fruit = np.maximum(box_ious(boxes, true).max(axis=1, initial=0.0), share_inside(boxes, true))
    return [
        True if k in hits else None if on_fruit[k] > _AMBIGUOUS_OVERLAP else False
        for k in range(len(boxes))
    ]
