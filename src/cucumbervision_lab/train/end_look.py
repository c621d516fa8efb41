"""Train the network that looks at each end of a fruit, and learn the intervals by its looks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cucumbervision.fruit.crops import END_PX, PLANES, QUANTILES, EndCrop, EndLook
from cucumbervision.methods import intervals
from cucumbervision.methods.selector import LookAtEnds
from cucumbervision.networks.find import ERROR_SCALE, STATES, EndLooker, looked_at
from cucumbervision_lab.evaluate.benchmark import (
    TUBE_FEATURES,
    fit_interval_model,
    write_interval_models,
)
from cucumbervision_lab.train import classifier
from cucumbervision_lab.train.end_crops import MeasuredFruit, states_of
from cucumbervision_lab.train.fruit_crops import Crops

_LIMITS = (
    "Trained on drawn fruit, on real ones pasted into photos, and on photos of fruit on the "
    "plant, with real leaves and drawn stems laid over ends; on none on the plant before a "
    "depth camera.",
    "Its quantiles are too narrow; the intervals that are learnt from them less.",
    "Withered flowers, burnt stem ends and dry leaves are told apart less well than green leaves.",
)
OUTPUTS = len(STATES) + len(QUANTILES) + 1
_AT_ONCE = 256  # crops
_HIDDEN = 64
_GRID = 2  # the features of a crop are averaged over 2 by 2 parts
_SHAPE_MEAN, _SHAPE_SD = (2.2, 2.9), (0.5, 0.6)  # of the logarithms of aspect and radius, pixels


def make_network(init: Path | str) -> Any:
    """Build the network: the first layers of YOLO26n, on six planes, and two new layers.

    Parameters
    ----------
    init : Path
        As in `first_layers`.

    Returns
    -------
    torch.nn.Module
        Inputs: crops, float32 of shape (N, 6, 64, 64), range 0 to 1, and shapes, (N, 2). Output:
        (N, 9), as `looked_at` takes a row of it.
    """
    import torch
    from torch import nn

    class Look(nn.Module):  # type: ignore[misc]
        """What an end looks like."""

        def __init__(self) -> None:
            super().__init__()
            layers = classifier.first_layers(init)
            layers[0].conv = with_planes(layers[0].conv)
            self.trunk = nn.Sequential(*layers).float()
            self.pool = nn.AvgPool2d(END_PX // 16 // _GRID)
            self.register_buffer("mean", torch.tensor(_SHAPE_MEAN))
            self.register_buffer("sd", torch.tensor(_SHAPE_SD))
            self.head = nn.Sequential(
                nn.Dropout(0.2),
                nn.Linear(classifier.CHANNELS * _GRID**2 + 2, _HIDDEN),
                nn.SiLU(),
                nn.Linear(_HIDDEN, OUTPUTS),
            )

        def forward(self, crops: Any, shapes: Any) -> Any:
            """Return the outputs."""
            pooled = self.pool(self.trunk(crops)).flatten(1)
            output = self.head(torch.cat([pooled, (shapes - self.mean) / self.sd], 1))
            first, steps = output[:, 3:4], nn.functional.softplus(output[:, 4:8])
            rising = torch.cat([first, first + torch.cumsum(steps, 1)], 1)
            return torch.cat([output[:, :3], rising, output[:, 8:]], 1)

    return Look().requires_grad_(True)


def with_planes(conv: Any) -> Any:
    """Return a convolution over `PLANES` planes that begins with the colours' weights alone."""
    import torch
    from torch import nn

    widened = nn.Conv2d(
        PLANES, conv.out_channels, conv.kernel_size, conv.stride, conv.padding, bias=False
    )
    with torch.no_grad():
        widened.weight.mul_(0.3)
        widened.weight[:, :3] = conv.weight.float()
    return widened


def fit_look(crops: Crops, init: Path | str, options: classifier.ClassifierOptions) -> Any:
    """Train the network on the crops that are not held out.

    Parameters
    ----------
    crops : recarray of END_CROP
        Of `collect_end_crops`.
    init : Path
        Checkpoint (.pt) to begin with: of YOLO26n, or an earlier one of this network.
    options : ClassifierOptions
        Options.

    Returns
    -------
    torch.nn.Module
        The network, ready to predict.
    """
    learnt = np.flatnonzero(~crops.held_out)
    labels = np.column_stack([states_of(crops), crops.missing, crops.stem]).astype(np.float32)

    def loss_of(network: Any, chosen: NDArray[np.intp]) -> Any:
        import torch

        rows = learnt[chosen]
        planes, shapes = (
            classifier.scaled_planes(crops.planes[rows]),
            torch.from_numpy(crops.shapes[rows]),
        )
        return _loss(network(augmented(planes), shapes), torch.from_numpy(labels[rows]))

    return classifier.fit(
        lambda: classifier.begun_network(init, make_network), len(learnt), loss_of, options
    )


def _loss(output: Any, target: Any) -> Any:
    """Return the loss: state, quantiles and stem end, each over the crops with such a label."""
    import torch
    from torch.nn.functional import binary_cross_entropy_with_logits, cross_entropy

    state, missing, stem = target.T
    told, measured, turned = state >= 0, ~missing.isnan(), ~stem.isnan()
    total = cross_entropy(output[told, :3], state[told].long(), label_smoothing=0.01)
    if measured.any():
        off = torch.asinh(missing[measured, None] / ERROR_SCALE) - output[measured, 3:8]
        level = torch.tensor(QUANTILES)
        total = total + torch.maximum(level * off, (level - 1) * off).mean()
    if turned.any():
        total = total + 0.3 * binary_cross_entropy_with_logits(output[turned, 8], stem[turned])
    return total


def augmented(crops: Any) -> Any:
    """Mirror crops about the axis, change their light, and take depth or parts of it away."""
    import torch

    mirrored = (torch.rand(len(crops)) < 0.5)[:, None, None, None]
    crops = torch.where(mirrored, crops.flip(2), crops)
    return classifier.changed_planes(crops, 0.3, no_depth=0.35, side_px=3)


def predict_looks(network: Any, crops: Crops) -> list[EndLook]:
    """Return what the network says of crops, the mean of each and its mirror image."""
    import torch

    looks: list[EndLook] = []
    with torch.no_grad():
        for start in range(0, len(crops), _AT_ONCE):
            planes = classifier.scaled_planes(crops.planes[start : start + _AT_ONCE])
            shapes = torch.from_numpy(crops.shapes[start : start + _AT_ONCE])
            mean = (network(planes, shapes) + network(planes.flip(2), shapes)) / 2
            looks += [looked_at(row) for row in mean.numpy().astype(np.float64)]
    return looks


def train_look(
    crops: Crops, init: Path | str, out: Path, options: classifier.ClassifierOptions
) -> classifier.Trained:
    """Train the network, export it to ONNX, and judge it by the held-out scenes.

    Parameters
    ----------
    crops : recarray of END_CROP
        Of `collect_end_crops`.
    init : Path
        Checkpoint (.pt) of YOLO26n to begin with.
    out : Path
        The ONNX file to write; the checkpoint lies beside it.
    options : ClassifierOptions
        Options of training.

    Raises
    ------
    MissingExtraError
        If the extra `train` is not installed.
    ModelError
        If the checkpoint cannot be loaded.
    """
    import torch

    network = fit_look(crops, init, options)
    inputs = {"crops": torch.zeros(2, PLANES, END_PX, END_PX), "shapes": torch.zeros(2, 2)}
    classifier.export_network(network, out, inputs, ("looks",), "look")
    return judge_look(network, crops, out)


def judge_look(network: Any, crops: Crops, out: Path) -> classifier.Trained:
    """Return how well a network tells the held-out ends apart."""
    ends = crops[crops.held_out & ~crops.moved & ~np.isnan(crops.missing)]
    looks = predict_looks(network, ends)
    covered = np.array([look.covered for look in looks])
    outer = np.array([(look.missing[0], look.missing[-1]) for look in looks]).reshape(-1, 2)
    inside = (outer[:, 0] <= ends.missing) & (ends.missing <= outer[:, 1])
    stem = np.array([look.stem > 0.5 for look in looks]) == (ends.stem > 0.5)
    metrics = {
        classifier.LEARNT_FROM: float((~crops.held_out).sum()),
        "ends of other scenes judged by": float(len(looks)),
        "covered ends told from others, area under the curve": area_under_curve(
            covered, states_of(ends) == STATES.index("covered")
        ),
        "missing length between the outer quantiles": float(inside.mean()) if looks else math.nan,
        "stem and blossom ends told right": float(stem.mean()) if looks else math.nan,
    }
    return classifier.Trained(out, "look", _LIMITS, metrics)


def area_under_curve(scores: NDArray[np.float64], positive: NDArray[np.bool_]) -> float:
    """Return the area under the ROC curve; NaN without both kinds.

    Examples
    --------
    >>> area_under_curve(np.array([0.1, 0.4, 0.35, 0.8]), np.array([False, False, True, True]))
    0.75
    """
    from scipy.stats import rankdata

    count = int(positive.sum())
    if count in (0, len(positive)):
        return float("nan")
    ranks = rankdata(scores)[positive].sum() - count * (count + 1) / 2
    return float(ranks / (count * (len(positive) - count)))


LOOK_FEATURES = (
    *(name for name in TUBE_FEATURES if name != "closed"),
    *("covered", "running_on", "log_missing", "log_above", "log_below"),
)

LOOK_EDGES: tuple[tuple[str, tuple[float, ...]], ...] = (
    ("covered", (0.1, 0.5)),
    ("distance_m", (1.2,)),
)
"""Groups: by how likely the look says that fruit go on out of sight, and by distance.

Farther away a pixel of an outline is a larger part of the length.
"""

SMALLEST_GROUP = 100
"""Fruit of a group that has quantiles of its own."""

LEAST_FRUIT = 60
"""Fruit without which no intervals are learnt."""

_KEYS = ("M6", "M6 thread", "M6 chord")


def looked_fruit(
    fruit: Sequence[MeasuredFruit], crops: Crops, look: LookAtEnds
) -> tuple[list[MeasuredFruit], list[tuple[EndLook, EndLook]]]:
    """Return the held-out fruit on networks' masks, and what a network says of their ends.

    Parameters
    ----------
    fruit : sequence of MeasuredFruit
        As the crops number them.
    crops : recarray of END_CROP
        Both ends of each fruit, one after the other.
    look : callable
        What looks, as `EndLooker.look`.
    """
    drawn = np.array([not measured.given for measured in fruit])[crops.fruit]
    held = crops[crops.held_out & ~crops.moved & drawn]
    looks: list[EndLook] = []
    for start in range(0, len(held), _AT_ONCE):
        part = held[start : start + _AT_ONCE]
        looks += look(
            [EndCrop(crop.planes, (float(crop.shapes[0]), float(crop.shapes[1]))) for crop in part]
        )
    chosen = [fruit[k] for k in held.fruit[::2]]
    return chosen, list(zip(looks[::2], looks[1::2], strict=True))


def fit_look_intervals(
    fruit: Sequence[MeasuredFruit], looks: Sequence[tuple[EndLook, EndLook]], level: float = 0.90
) -> dict[str, intervals.IntervalModel]:
    """Fit interval models of M6's three lengths on fruit whose ends were looked at.

    Parameters
    ----------
    fruit : sequence of MeasuredFruit
        Measured on masks that networks drew, of scenes that the network did not learn from. Those
        that the picture's edge cuts are left out, and those with hardly any depth.
    looks : sequence of (EndLook, EndLook)
        What their ends look like.
    level : float
        Nominal coverage.

    Raises
    ------
    ValueError
        If there are too few fruit for the level.
    """
    candidates = [
        (measured, {**measured.features, **intervals.look_features(pair)})
        for measured, pair in zip(fruit, looks, strict=True)
    ]
    chosen = [
        (measured, row)
        for measured, row in candidates
        if not (measured.given or measured.cut or intervals.has_no_interval(row))
    ]
    features = {name: np.array([row.get(name, 0.0) for _, row in chosen]) for name in LOOK_FEATURES}
    names = [measured.picture for measured, _ in chosen]
    models = {}
    for k, key in enumerate(_KEYS):
        errors = np.log([measured.lengths_m[k] / measured.true_m[k] for measured, _ in chosen])
        name = key + intervals.PERCEIVED + intervals.LOOKED
        models[name] = fit_interval_model(
            name,
            errors,
            features,
            names,
            level,
            LOOK_EDGES,
            smallest_group=SMALLEST_GROUP,
            missing="log_missing",
        )
    return models


def learn_look_intervals(
    fruit: Sequence[MeasuredFruit], crops: Crops, network: Path, file: Path
) -> int:
    """Write the shipped intervals with those by a network's looks; return how many fruit taught it.

    Too few fruit teach nothing, and no file is written.
    """
    chosen, looks = looked_fruit(fruit, crops, EndLooker(network).look)
    if len(chosen) >= LEAST_FRUIT:
        book = intervals.shipped_interval_models()
        models = {**book.models, **fit_look_intervals(chosen, looks)}
        write_interval_models(file, replace(book, models=models))
    return len(chosen)
