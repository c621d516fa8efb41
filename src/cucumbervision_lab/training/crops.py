"""Train the network that looks at each detection alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.special import logit

from cucumbervision.capture.pictures import read_color
from cucumbervision.errors import TrainingError
from cucumbervision.instances.boxes import box_ious
from cucumbervision.perception.confidence import CANDIDATE_CONFIDENCE, DEFAULT_CONFIDENCE
from cucumbervision.perception.crops import CROP_MARGIN, CROP_PX, crop_square, lowered
from cucumbervision.perception.networks import NetworkLoader
from cucumbervision_lab.datasets.labels import DataSet, LabelledPicture, ticked
from cucumbervision_lab.datasets.splits import is_held_out
from cucumbervision_lab.detection.learn import true_positives
from cucumbervision_lab.detection.pictures import frame_of
from cucumbervision_lab.training.classifier import (
    CHANNELS,
    ClassifierOptions,
    export_classifier,
    first_layers,
    fit_classifier,
    predict,
)

if TYPE_CHECKING:
    from cucumbervision.instances.instance import Instance
    from cucumbervision.perception.yolo import YoloDetector

SURROUND_PX = 128
"""Side of the crops to train on: 16 px more on each side than the network sees, to move it in."""

HELD_OUT = 8
"""One of so many scenes is used for validation, as is the split val."""

MOST = 12
"""Candidates of a picture that are cut out."""

_SMOOTH = 0.02
_REPEATS = 4  # of false positives that the detector alone would report: few, and what it is for
_TURN_RAD, _SCALE, _SHIFT = 0.25, 0.12, 0.08  # largest random changes of a crop


@dataclass(frozen=True, eq=False)
class Crops:
    """Crops around what a detector proposes.

    Parameters
    ----------
    pictures : ndarray of uint8, shape (N, 128, 128, 3)
        RGB.
    is_fruit : ndarray of bool, shape (N,)
        Whether the detection is a true positive.
    confidence : ndarray of float64, shape (N,)
        The detector's confidence, 0 to 1.
    held_out : ndarray of bool, shape (N,)
        Whether the scene belongs to the validation set.
    """

    pictures: NDArray[np.uint8]
    is_fruit: NDArray[np.bool_]
    confidence: NDArray[np.float64]
    held_out: NDArray[np.bool_]


@dataclass(frozen=True)
class CropsResult:
    """Result of training the crop classifier.

    Parameters
    ----------
    network : Path
        The ONNX file.
    train_count, val_count : int
        Number of crops for training and for validation.
    fruit, others : tuple of int, length 2
        True and false positives of the validation set at the default confidence, without and with
        the network.
    """

    network: Path
    train_count: int
    val_count: int
    fruit: tuple[int, int]
    others: tuple[int, int]

    task: ClassVar = "crops"
    limits: ClassVar = (
        "Trained on what the packaged detector proposes; other detectors make other mistakes.",
        "Fruit of which leaves hide more than half are lowered more often than fruit in full view.",
    )

    @property
    def metrics(self) -> dict[str, float]:
        """Metrics of the validation set, as the card names them."""
        return {
            "crops learnt from": float(self.train_count),
            "crops of other scenes judged by": float(self.val_count),
            "true positives without it": float(self.fruit[0]),
            "true positives with it": float(self.fruit[1]),
            "false positives without it": float(self.others[0]),
            "false positives with it": float(self.others[1]),
        }


def collect_crops(sets: Sequence[DataSet], progress: Callable[[int], None] | None = None) -> Crops:
    """Cut out what the packaged detector proposes in data sets.

    Parameters
    ----------
    sets : sequence of DataSet
        Completely labelled pictures, also such without fruit. Those of the split 'test' are
        skipped; the split 'val' is used for validation. Detections in ignored regions, duplicates
        and parts of fruit are left out.
    progress : callable, optional
        Called with 1 after each picture.

    Raises
    ------
    TrainingError
        If there are no such crops, or all or none of them are for validation.
    CaptureError
        If a picture cannot be read.
    """
    detector = proposing_detector()
    rows: list[tuple[NDArray[np.uint8], bool, float, bool]] = []
    for dataset in sets:
        for picture in ticked(dataset.pictures, progress):
            if picture.split == "test":
                continue
            judged = is_held_out(picture, HELD_OUT)
            color = read_color(dataset.path(picture))
            instances = detector.detect(color)
            labels = labels_of(picture, dataset, instances)
            judged_instances = [
                (o, y) for o, y in zip(instances, labels, strict=True) if y is not None
            ][:MOST]
            margin = CROP_MARGIN * SURROUND_PX / CROP_PX
            rows += [
                (
                    crop_square(color, instance.box, SURROUND_PX, margin),
                    is_fruit,
                    instance.confidence,
                    judged,
                )
                for instance, is_fruit in judged_instances
            ]
    held = [row[3] for row in rows]
    if not rows or all(held) or not any(held):
        raise too_few_scenes(sets)
    pictures, is_fruit, confidence, held_out = zip(*rows, strict=True)
    return Crops(np.stack(pictures), np.array(is_fruit), np.array(confidence), np.array(held_out))


def proposing_detector() -> YoloDetector:
    """Load the packaged detector, which reports what it hardly believes, too."""
    loader = NetworkLoader(confidence=CANDIDATE_CONFIDENCE, most_fruit=4 * MOST)
    # By its file, so that no earlier classifier takes part.
    return loader.yolo(loader.verify("cucumber-seg")["network"])


def too_few_scenes(sets: Sequence[DataSet]) -> TrainingError:
    """Return the error of sets of which no scenes can be held out."""
    return TrainingError(
        "too few scenes in which the detector proposes anything",
        source=sets[0].folder if sets else None,
        remedy=f"give at least {HELD_OUT} scenes with fruit",
    )


def labels_of(
    picture: LabelledPicture, data: DataSet, instances: Sequence[Instance]
) -> list[bool | None]:
    """Return whether each detection is a true positive; None where that cannot be told."""
    boxes = np.array([instance.box for instance in instances]).reshape(-1, 4)
    frame = frame_of(picture, data, None)
    unknown = np.array([fruit.box for fruit in frame.true if fruit.ignore or fruit.optional])
    overlap = box_ious(boxes, unknown.reshape(-1, 4)).max(axis=1, initial=0.0)
    judged = true_positives(frame, boxes)
    return [None if share > 0 and not y else y for y, share in zip(judged, overlap, strict=True)]


def make_network(init: Path | str) -> Any:
    """Build the network: the first layers of YOLO26n, and one new layer.

    Parameters
    ----------
    init : Path
        As in `first_layers`.

    Returns
    -------
    torch.nn.Module
        Input: crops, float32 of shape (N, 3, 96, 96), range 0 to 1. Output: logits of shape (N,)
        for 'this is a cucumber'.
    """
    from torch import nn

    network = nn.Sequential(
        *first_layers(init),
        nn.AdaptiveAvgPool2d(1),
        nn.Flatten(),
        nn.Dropout(0.2),
        nn.Linear(CHANNELS, 1),
        nn.Flatten(0),
    ).float()
    return network.requires_grad_(True)


def train_crops(
    crops: Crops, init: Path | str, out: Path, options: ClassifierOptions
) -> CropsResult:
    """Train the network and export it to ONNX.

    Parameters
    ----------
    crops : Crops
        Training and validation crops from `collect_crops`.
    init : Path
        Checkpoint (.pt) of YOLO26n-seg to begin with.
    out : Path
        The ONNX file to write.
    options : ClassifierOptions
        Options of training.

    Raises
    ------
    MissingExtraError
        If the extra `train` is not installed.
    ModelError
        If the checkpoint cannot be loaded.
    """
    reported = ~crops.is_fruit & (crops.confidence > DEFAULT_CONFIDENCE)
    learnt = np.repeat(np.arange(len(reported)), np.where(reported, _REPEATS, 1))
    learnt = learnt[~crops.held_out[learnt]]
    target = np.where(crops.is_fruit[learnt], 1 - _SMOOTH, _SMOOTH).astype(np.float32)
    network = fit_classifier(
        lambda: make_network(init),
        crops.pictures[learnt],
        target,
        _augment,
        options,
    )
    _subtract_prior(network, float(crops.is_fruit[learnt].mean()))
    export_classifier(network, out, (CROP_PX, CROP_PX), "crops")
    inner = slice((SURROUND_PX - CROP_PX) // 2, (SURROUND_PX + CROP_PX) // 2)
    log_odds = predict(network, crops.pictures[crops.held_out][:, inner, inner])
    return _result(log_odds, crops, out)


def _subtract_prior(network: Any, share: float) -> None:
    """Leave in a network's logits the evidence alone, without the share of fruit in its training.

    How likely a detection is before its crop is looked at, the detector's confidence says.
    """
    import torch

    with torch.no_grad():
        network[-2].bias -= float(logit(share))


def _augment(crops: Any) -> Any:
    """Turn, scale, move and mirror crops at random, cut them to size, and change their light."""
    import torch
    from torch.nn.functional import affine_grid, grid_sample

    count = len(crops)

    def spread(limit: float) -> Any:
        return limit * (2 * torch.rand(count) - 1)

    angle, mirror = spread(_TURN_RAD), torch.where(torch.rand(count) < 0.5, 1.0, -1.0)
    scale = CROP_PX / SURROUND_PX * (1 + spread(_SCALE))
    rows = [
        torch.stack([mirror * scale * angle.cos(), -scale * angle.sin(), spread(_SHIFT)], 1),
        torch.stack([mirror * scale * angle.sin(), scale * angle.cos(), spread(_SHIFT)], 1),
    ]
    grid = affine_grid(torch.stack(rows, 1), [count, 3, CROP_PX, CROP_PX], align_corners=False)
    sampled = grid_sample(crops, grid, padding_mode="border", align_corners=False)
    gain = 1 + 0.2 * torch.randn(count, 1, 1, 1) + 0.06 * torch.randn(count, 3, 1, 1)
    noise = 0.03 * torch.rand(count, 1, 1, 1) * torch.randn_like(sampled)
    return (sampled * gain + 0.05 * torch.randn(count, 1, 1, 1) + noise).clamp(0, 1)


def _result(log_odds: NDArray[np.float64], crops: Crops, out: Path) -> CropsResult:
    before = crops.confidence[crops.held_out]
    after = np.array([lowered(*pair) for pair in zip(before, log_odds, strict=True)])
    is_fruit = crops.is_fruit[crops.held_out]

    def reported(group: NDArray[np.bool_]) -> tuple[int, int]:
        counts = (int((scores[group] > DEFAULT_CONFIDENCE).sum()) for scores in (before, after))
        return next(counts), next(counts)

    learnt = int((~crops.held_out).sum())
    return CropsResult(out, learnt, len(before), reported(is_fruit), reported(~is_fruit))
