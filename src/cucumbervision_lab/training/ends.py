"""Train the network that classifies which end of a fruit is the stem end."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from cucumbervision.capture.pictures import read_color
from cucumbervision.errors import TrainingError
from cucumbervision.geometry.curve import arc_positions
from cucumbervision.instances.instance import LEAST_END_CONFIDENCE
from cucumbervision.perception.ends import STRIP_PX, orient
from cucumbervision.perception.yolo_layout import BY_PLACE
from cucumbervision_lab.datasets.labels import KEYPOINT_ORDER, DataSet, Label, ticked
from cucumbervision_lab.training.classifier import (
    CHANNELS,
    ClassifierOptions,
    export_classifier,
    first_layers,
    fit_classifier,
    predict,
)

COPIES = 3  # augmented copies of each fruit, each with different keypoint noise
_ALONG_SD, _ASIDE_SD = 0.04, 0.02  # error of a pose network's keypoints, as shares of the length
_HELD_OUT = 8  # every eighth scene is used for validation, as is the split val
_SEEN = 2
_LABEL_SMOOTHING = 0.02


@dataclass(frozen=True, eq=False)
class Strips:
    """Strips of fruit straightened along their axis, with the stem end to the right.

    Parameters
    ----------
    pictures : ndarray of uint8, shape (N, 64, 192, 3)
        RGB.
    seen : ndarray of int64, shape (N,)
        Number of visible ends, 0 to 2.
    held_out : ndarray of bool, shape (N,)
        Whether the scene belongs to the validation set.
    """

    pictures: NDArray[np.uint8]
    seen: NDArray[np.int64]
    held_out: NDArray[np.bool_]


@dataclass(frozen=True)
class EndsResult:
    """Result of training the end classifier.

    Parameters
    ----------
    network : Path
        The ONNX file.
    train_count, val_count : int
        Number of fruit for training (before augmentation) and for validation.
    accuracy : dict of str to float
        Share of validation fruit classified correctly: 'all', and by number of visible ends.
    confident_share, confident_accuracy : float
        Share of validation fruit with a probability of at least 0.9, and the accuracy on these.
    """

    network: Path
    train_count: int
    val_count: int
    accuracy: dict[str, float]
    confident_share: float
    confident_accuracy: float

    task: ClassVar = "ends"
    limits: ClassVar = (
        "Where neither end is visible, only colour and taper are available.",
        "Trained with keypoint errors of 4 % of the length along the fruit and 2 % across it; "
        "larger errors reduce accuracy.",
        "Probabilities are calibrated on synthetic fruit and on photos of harvested fruit.",
    )

    @property
    def metrics(self) -> dict[str, float]:
        """Metrics of the validation set, as the card names them."""
        return {
            "fruit learnt from": float(self.train_count),
            "fruit of other scenes judged by": float(self.val_count),
            **{f"right, {kind}": share for kind, share in self.accuracy.items()},
            "at least 90 % sure": self.confident_share,
            "right of these": self.confident_accuracy,
        }


def collect_strips(
    sets: Sequence[DataSet], seed: int = 0, progress: Callable[[int], None] | None = None
) -> Strips:
    """Extract all fruit with five labelled keypoints from data sets.

    Parameters
    ----------
    sets : sequence of DataSet
        Sets with keypoints; a set listed twice counts twice. Pictures of the split 'test' and
        fruit with unknown stem end are skipped; the split 'val' is used for validation.
    seed : int
        Random seed of the keypoint noise.
    progress : callable, optional
        Called with 1 after each picture.

    Raises
    ------
    TrainingError
        If there are no such fruit, or all or none of them are for validation.
    CaptureError
        If a picture cannot be read.
    """
    rng = np.random.default_rng(seed)
    strips_found: list[NDArray[np.uint8]] = []
    ends_seen: list[int] = []
    held: list[bool] = []
    scenes: dict[str, int] = {}
    for dataset in sets:
        for picture in ticked(dataset.pictures, progress):
            fruit = [x for x in picture.labels if _usable(x)] if picture.split != "test" else []
            if fruit:
                color = read_color(dataset.path(picture))
                scene = scenes.setdefault(picture.scene or picture.file, len(scenes))
                for label in fruit:
                    strips = _copies(rng, color, label)
                    strips_found += strips
                    ends_seen += [_ends_seen(label)] * len(strips)
                    judged = picture.split == "val" or scene % _HELD_OUT == _HELD_OUT - 1
                    held += [judged] * len(strips)
    if not strips_found or all(held) or not any(held):
        raise TrainingError(
            "too few scenes have fruit with five labelled keypoints",
            source=sets[0].folder if sets else None,
            remedy=f"give at least {_HELD_OUT} scenes with keypoints",
        )
    return Strips(np.stack(strips_found), np.array(ends_seen), np.array(held))


def _usable(label: Label) -> bool:
    unknown_stem = label.extras.get(KEYPOINT_ORDER) == BY_PLACE
    if label.ignore or label.keypoints is None or unknown_stem:
        return False
    return bool(label.keypoints[:, 2].all())


def _ends_seen(label: Label) -> int:
    points = label.keypoints
    return 0 if points is None else int((points[[0, -1], 2] == _SEEN).sum())


def _copies(
    rng: np.random.Generator, color: NDArray[np.uint8], label: Label
) -> list[NDArray[np.uint8]]:
    points = np.asarray(label.keypoints)[:, :2]
    length = float(arc_positions(points)[-1])
    strips = []
    for _ in range(COPIES):
        moved = points + rng.normal(0, _ASIDE_SD * length, points.shape)
        for tip, inner in ((0, 1), (-1, -2)):
            out = points[tip] - points[inner]
            out /= max(float(np.linalg.norm(out)), 1e-9)
            moved[tip] += out * rng.normal(0, _ALONG_SD * length)
        strip = orient(color, moved)
        if strip is not None:
            strips.append(strip)
    return strips


def make_network(init: Path | str) -> Any:
    """Build the network: the first layers of YOLO26n, and one new layer.

    Parameters
    ----------
    init : Path
        As in `first_layers`.

    Returns
    -------
    torch.nn.Module
        Input: strips, float32 of shape (N, 3, 64, 192), range 0 to 1. Output: logits of shape (N,)
        for 'the stem end is to the right'. Rotating a strip by 180 degrees negates its logit.
    """
    import torch
    from torch import nn

    class Ends(nn.Module):  # type: ignore[misc]
        """Difference of the scores of a strip and of the strip rotated by 180 degrees."""

        def __init__(self) -> None:
            super().__init__()
            height, width = (side // 16 for side in STRIP_PX)
            self.score = nn.Sequential(
                *first_layers(init),
                nn.AvgPool2d((height, 1)),
                nn.Flatten(),
                nn.Dropout(0.2),
                nn.Linear(CHANNELS * width, 1),
            ).float()

        def forward(self, fruit: Any) -> Any:
            """Return the logits."""
            # One batch for both orientations, so that batch norm treats them alike.
            right, mirrored = self.score(torch.cat([fruit, torch.flip(fruit, (2, 3))])).view(2, -1)
            return right - mirrored

    return Ends().requires_grad_(True)


def train_ends(
    strips: Strips, init: Path | str, out: Path, options: ClassifierOptions
) -> EndsResult:
    """Train the network and export it to ONNX.

    Parameters
    ----------
    strips : Strips
        Training and validation strips from `collect_strips`.
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
    learnt = strips.pictures[~strips.held_out]
    target = np.full(len(learnt), 1 - _LABEL_SMOOTHING, np.float32)
    network = fit_classifier(lambda: make_network(init), learnt, target, _augment, options)
    export_classifier(network, out, STRIP_PX, "ends")
    logits = predict(network, strips.pictures[strips.held_out])
    return _result(logits, strips.seen[strips.held_out], out, len(learnt))


def _augment(fruit: Any) -> Any:
    """Randomise brightness, colour and noise, and mirror the fruit about its axis."""
    import torch

    count = len(fruit)
    mirrored = torch.rand(count) < 0.5
    fruit = torch.where(mirrored[:, None, None, None], fruit.flip(2), fruit)
    gain = 1 + 0.25 * torch.randn(count, 1, 1, 1) + 0.08 * torch.randn(count, 3, 1, 1)
    noise = 0.03 * torch.rand(count, 1, 1, 1) * torch.randn_like(fruit)
    return (fruit * gain + 0.05 * torch.randn(count, 1, 1, 1) + noise).clamp(0, 1)


def _result(
    logits: NDArray[np.float64], seen: NDArray[np.int64], out: Path, trained: int
) -> EndsResult:
    accuracy = {"all": float((logits > 0).mean())}
    for count in (0, 1, 2):
        group = seen == count
        if group.any():
            accuracy[f"{count} ends in sight"] = float((logits[group] > 0).mean())
    confident = expit(np.abs(logits)) >= LEAST_END_CONFIDENCE
    share = float((logits[confident] > 0).mean()) if confident.any() else float("nan")
    return EndsResult(
        out, trained // COPIES, len(logits) // COPIES, accuracy, float(confident.mean()), share
    )
