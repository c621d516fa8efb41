"""Train the network that looks at each end of a fruit."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cucumbervision.capture.pictures import read_color
from cucumbervision.errors import TrainingError
from cucumbervision.geometry.curve import arc_positions, points_along
from cucumbervision.perception.end_look import (
    END_PX,
    ERROR_SCALE,
    PLANES,
    QUANTILES,
    STATES,
    EndLook,
    end_crop,
    looked_at,
)
from cucumbervision_lab.datasets.labels import ticked
from cucumbervision_lab.detection.pictures import capture_of
from cucumbervision_lab.training.checkpoint import import_ultralytics
from cucumbervision_lab.training.classifier import (
    CHANNELS,
    classifier_card,
    export_network,
    first_layers,
)
from cucumbervision_lab.training.measured_ends import (
    is_held_out,
    labelled_fruit,
    read_measured,
    write_measured,
)
from cucumbervision_lab.training.publish import ModelCard

if TYPE_CHECKING:
    from cucumbervision.capture.frames import Capture
    from cucumbervision_lab.datasets.labels import DataSet
    from cucumbervision_lab.training.measured_ends import MeasuredFruit

MISSING = 0.05
"""Share of a fruit's length from which an end counts as covered, or as running on."""

OUTPUTS = len(STATES) + len(QUANTILES) + 1
_MOVED_SD = 0.7  # radii that a further copy of each end of training is moved along the axis
_RATE, _WEIGHT_DECAY = 2e-3, 0.02
_HIDDEN = 64
_GRID = 2  # the features of a crop are averaged over 2 by 2 parts
_NO_DEPTH, _HOLES = 0.2, 0.3  # shares of the crops of a batch that lose their depth, or parts of it
_LIMITS = (
    "Trained on drawn fruit only, at the ends of M6 and of labels.",
    "Withered flowers, burnt stem ends and dry leaves are told apart less well than green leaves.",
)
_SHAPE_MEAN, _SHAPE_SD = (2.2, 2.9), (0.5, 0.6)  # of the logarithms of aspect and radius, pixels


@dataclass(frozen=True, eq=False)
class EndCrops:
    """Crops around the ends of measured fruit.

    Parameters
    ----------
    planes : ndarray of uint8, shape (N, 64, 64, 6)
        As `EndCrop.planes`.
    shapes : ndarray of float32, shape (N, 2)
        As `EndCrop.shape`.
    missing : ndarray of float32, shape (N,)
        Share of the true length that is missing there; negative where too much was measured; NaN
        where it is not known.
    covered : ndarray of float32, shape (N,)
        Whether the end is covered or cut, where only that is known; NaN elsewhere.
    stem : ndarray of float32, shape (N,)
        Whether it is the stem end; NaN where that is not known.
    fruit : ndarray of int64, shape (N,)
        Number of the fruit among those that were given.
    moved : ndarray of bool, shape (N,)
        Whether it is a copy that was moved along the axis.
    held_out : ndarray of bool, shape (N,)
        Whether its scene is not trained on.
    """

    planes: NDArray[np.uint8]
    shapes: NDArray[np.float32]
    missing: NDArray[np.float32]
    covered: NDArray[np.float32]
    stem: NDArray[np.float32]
    fruit: NDArray[np.int64]
    moved: NDArray[np.bool_]
    held_out: NDArray[np.bool_]

    @property
    def state(self) -> NDArray[np.int64]:
        """Index into `STATES`; -1 where it is not known."""
        by_length = np.where(self.missing > MISSING, 1, np.where(self.missing < -MISSING, 2, 0))
        by_eye = np.where(np.isnan(self.covered), -1, np.where(self.covered > 0.5, 1, 0))
        return np.where(np.isnan(self.missing), by_eye, by_length).astype(np.int64)

    @classmethod
    def joined(cls, parts: Sequence[EndCrops]) -> EndCrops:
        """Return the crops of several sets as one; fruit are numbered on."""
        first = np.cumsum([0, *(int(part.fruit.max(initial=-1)) + 1 for part in parts)])
        fruit = [part.fruit + k for part, k in zip(parts, first, strict=False)]
        columns = {
            name: np.concatenate([getattr(part, name) for part in parts])
            for name in cls.__dataclass_fields__
        }
        return cls(**(columns | {"fruit": np.concatenate(fruit)}))

    def only(self, chosen: NDArray[Any]) -> EndCrops:
        """Return some of the crops."""
        return EndCrops(*(getattr(self, name)[chosen] for name in self.__dataclass_fields__))


def moved_axis(axis_m: NDArray[np.float64], by_m: float) -> NDArray[np.float64]:
    """Return an axis with its first end moved along it, outward where positive.

    Examples
    --------
    >>> axis = np.stack([np.linspace(0, 0.1, 11), np.zeros(11), np.ones(11)], axis=1)
    >>> [round(float(moved_axis(axis, by)[0, 0]), 3) for by in (0.02, -0.02)]
    [-0.02, 0.02]
    """
    run = arc_positions(axis_m)
    if by_m < 0:
        return points_along(axis_m, np.linspace(min(-by_m / run[-1], 0.9), 1, len(axis_m)))
    out = axis_m[0] - axis_m[1]
    tip = axis_m[0] + by_m * out / max(float(np.linalg.norm(out)), 1e-9)
    return np.vstack([tip, axis_m[1:]])


def collect_end_crops(
    fruit: Sequence[MeasuredFruit],
    data: DataSet,
    seed: int = 0,
    progress: Callable[[int], None] | None = None,
) -> EndCrops:
    """Cut out both ends of fruit, and of those of training each once more, moved along the axis.

    Parameters
    ----------
    fruit : sequence of MeasuredFruit
        Of `read_measured`, those of a picture one after the other.
    data : DataSet
        Their set.
    seed : int
        Random seed of the moves.
    progress : callable, optional
        Called with 1 after each picture.

    Raises
    ------
    TrainingError
        If there are no fruit.
    CaptureError
        If a picture cannot be read.
    """
    pictures = {picture.file: picture for picture in data.pictures}
    rng, rows = np.random.default_rng(seed), []
    numbered = list(enumerate(fruit))
    of_pictures = [list(some) for _, some in groupby(numbered, lambda one: one[1].picture)]
    for some in ticked(of_pictures, progress):
        picture = pictures[some[0][1].picture]
        capture = capture_of(picture, data, read_color(data.path(picture)))
        if capture is not None:
            for number, measured in some:
                rows += _crops_of(number, measured, capture, rng)
    if not rows:
        raise TrainingError(
            "no measured fruit", source=data.folder, remedy="give a drawn set with depth"
        )
    planes, shapes, missing, stem, numbers, moved, held = zip(*rows, strict=True)
    count = len(rows)
    return EndCrops(
        np.stack(planes),
        np.array(shapes, np.float32),
        np.array(missing, np.float32),
        np.full(count, np.nan, np.float32),
        np.array(stem, np.float32),
        np.array(numbers),
        np.array(moved),
        np.array(held),
    )


def collect_set(
    data: DataSet, keep: Path, seed: int = 0, progress: Callable[[int], None] | None = None
) -> EndCrops:
    """Measure the fruit of a drawn set, and cut out their ends.

    Those to train on are cut once more from the labels of all pictures.

    Parameters
    ----------
    data : DataSet
        A set by `cucumbervision synth` with depth.
    keep : Path
        The file of what is measured (`write_measured`).
    seed : int
        Random seed of the labels' errors and of the moves.
    progress : callable, optional
        Called with 1 after each picture that was measured.

    Raises
    ------
    TrainingError, CaptureError
        As `collect_end_crops`.
    """
    write_measured(data, keep, progress=progress)
    rng = np.random.default_rng(seed)
    learnt = [one for one in data.pictures if not is_held_out(one.scene or one.file)]
    fruit = [one for picture in learnt for one in labelled_fruit(picture, rng)]
    return collect_end_crops([*fruit, *read_measured([keep])], data, seed)


def _crops_of(
    number: int, fruit: MeasuredFruit, capture: Capture, rng: np.random.Generator
) -> list[tuple[Any, ...]]:
    axis, mask = np.array(fruit.axis_m), fruit.mask.decode()
    held, rows = is_held_out(fruit.scene), []
    for line, end in ((axis, fruit.ends[0]), (axis[::-1], fruit.ends[1])):
        moves = (0.0,) if held else (0.0, float(rng.normal(0, _MOVED_SD)) * fruit.diameter_m / 2)
        for by_m in moves:
            crop = end_crop(
                capture.color,
                capture.depth_m,
                mask,
                capture.intrinsics,
                moved_axis(line, by_m) if by_m else line,
                fruit.diameter_m,
            )
            missing = (end.missing_m - by_m) / fruit.true_m[0]
            rows.append((crop.planes, crop.shape, missing, end.is_stem, number, by_m != 0, held))
    return rows


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
            layers = first_layers(init)
            layers[0].conv = _with_planes(layers[0].conv)
            self.trunk = nn.Sequential(*layers).float()
            self.pool = nn.AvgPool2d(END_PX // 16 // _GRID)
            self.register_buffer("mean", torch.tensor(_SHAPE_MEAN))
            self.register_buffer("sd", torch.tensor(_SHAPE_SD))
            self.head = nn.Sequential(
                nn.Dropout(0.2),
                nn.Linear(CHANNELS * _GRID**2 + 2, _HIDDEN),
                nn.SiLU(),
                nn.Linear(_HIDDEN, OUTPUTS),
            )

        def forward(self, crops: Any, shapes: Any) -> Any:
            """Return the outputs."""
            seen = self.pool(self.trunk(crops)).flatten(1)
            found = self.head(torch.cat([seen, (shapes - self.mean) / self.sd], 1))
            first, steps = found[:, 3:4], nn.functional.softplus(found[:, 4:8])
            rising = torch.cat([first, first + torch.cumsum(steps, 1)], 1)
            return torch.cat([found[:, :3], rising, found[:, 8:]], 1)

    return Look().requires_grad_(True)


def _with_planes(conv: Any) -> Any:
    """Return a convolution over `PLANES` planes that begins with the colours' weights alone."""
    import torch
    from torch import nn

    wide = nn.Conv2d(
        PLANES, conv.out_channels, conv.kernel_size, conv.stride, conv.padding, bias=False
    )
    with torch.no_grad():
        wide.weight.mul_(0.3)
        wide.weight[:, :3] = conv.weight.float()
    return wide


@dataclass(frozen=True)
class LookResult:
    """How well ends of held-out scenes are told apart.

    Parameters
    ----------
    network : Path
        The ONNX file.
    train_count, val_count : int
        Number of crops for training, and of ends for validation.
    covered_auc : float
        Area under the ROC curve of the probability that an end is covered.
    quantiles_hold : float
        Share of what is missing that lies between the outer quantiles.
    stem_right : float
        Share of the ends that are told right as stem or blossom end.
    """

    network: Path
    train_count: int
    val_count: int
    covered_auc: float
    quantiles_hold: float
    stem_right: float


@dataclass(frozen=True)
class LookOptions:
    """Options of training.

    Parameters
    ----------
    epochs : int
        Number of passes over the training crops.
    seed : int
        Random seed.
    threads : int
        Number of torch threads; 0 uses all cores.
    batch : int
        Crops of a step.
    keep : Path, optional
        Checkpoint (.pt) of each epoch, from which an interrupted training goes on.
    progress : callable, optional
        Called after each epoch with the epoch number (from 1) and the mean loss.
    """

    epochs: int = 12
    seed: int = 0
    threads: int = 0
    batch: int = 96
    keep: Path | None = None
    progress: Callable[[int, float], None] | None = None


def fit_look(crops: EndCrops, init: Path | str, options: LookOptions) -> Any:
    """Train the network on the crops that are not held out.

    Parameters
    ----------
    crops : EndCrops
        Of `collect_end_crops`.
    init : Path
        Checkpoint (.pt) of YOLO26n to begin with.
    options : LookOptions
        Options.

    Returns
    -------
    torch.nn.Module
        The network, ready to predict.
    """
    import_ultralytics()  # raises a clear error if the extra, and with it torch, is missing
    import torch

    if options.threads:
        torch.set_num_threads(options.threads)
    torch.manual_seed(options.seed)
    network = make_network(init)
    learnt = np.flatnonzero(~crops.held_out)
    steps = options.epochs * (len(learnt) // options.batch + 1)
    optimiser = torch.optim.AdamW(network.parameters(), _RATE, weight_decay=_WEIGHT_DECAY)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, _RATE, steps)
    parts = {"network": network, "optimiser": optimiser, "schedule": schedule}
    first = _resumed(parts, options.keep)
    target = torch.from_numpy(np.column_stack([crops.state, crops.missing, crops.stem])).float()
    shapes = torch.from_numpy(crops.shapes)
    for epoch in range(first, options.epochs):
        network.train()
        order = np.random.default_rng([options.seed, epoch]).permutation(learnt)
        losses = []
        for chosen in np.array_split(order, len(order) // options.batch + 1):
            rows = np.sort(chosen)
            loss = _loss(
                network(augmented(_scaled(crops.planes[rows])), shapes[rows]), target[rows]
            )
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
            losses.append(loss.item())
        if options.keep is not None:
            state = {name: part.state_dict() for name, part in parts.items()}
            torch.save({"epoch": epoch + 1, **state}, options.keep)
        if options.progress is not None:
            options.progress(epoch + 1, float(np.mean(losses)))
    return network.eval()


def _resumed(parts: dict[str, Any], keep: Path | None) -> int:
    """Load what an interrupted training kept; return the epoch to go on with."""
    import torch

    if keep is None or not keep.exists():
        return 0
    state = torch.load(keep, weights_only=True)
    for name, part in parts.items():
        part.load_state_dict(state[name])
    return int(state["epoch"])


def _scaled(planes: NDArray[np.uint8]) -> Any:
    import torch

    return torch.from_numpy(np.ascontiguousarray(planes.transpose(0, 3, 1, 2))).float() / 255


def _loss(found: Any, target: Any) -> Any:
    """Return the loss: state, quantiles and stem end, each over the crops with such a label."""
    import torch
    from torch.nn.functional import binary_cross_entropy_with_logits, cross_entropy

    state, missing, stem = target.T
    told, measured, turned = state >= 0, ~missing.isnan(), ~stem.isnan()
    total = cross_entropy(found[told, :3], state[told].long(), label_smoothing=0.01)
    if measured.any():
        off = torch.asinh(missing[measured, None] / ERROR_SCALE) - found[measured, 3:8]
        level = torch.tensor(QUANTILES)
        total = total + torch.maximum(level * off, (level - 1) * off).mean()
    if turned.any():
        total = total + 0.3 * binary_cross_entropy_with_logits(found[turned, 8], stem[turned])
    return total


def augmented(crops: Any) -> Any:
    """Mirror crops about the axis, change their light, and take depth or parts of it away."""
    import torch

    count = len(crops)

    def chance(share: float) -> Any:
        return (torch.rand(count) < share)[:, None, None, None]

    crops = torch.where(chance(0.5), crops.flip(2), crops)
    color, rest = crops[:, :3], crops[:, 3:]
    gain = 1 + 0.3 * torch.randn(count, 1, 1, 1) + 0.1 * torch.randn(count, 3, 1, 1)
    shift = 0.06 * torch.randn(count, 1, 1, 1) + 0.02 * torch.randn(count, 3, 1, 1)
    power = (0.3 * torch.randn(count, 1, 1, 1)).exp()
    noise = 0.05 * torch.rand(count, 1, 1, 1) * torch.randn_like(color)
    grey = color.mean(1, keepdim=True)
    vivid = 1 + 0.3 * torch.randn(count, 1, 1, 1)
    blurred = torch.nn.functional.avg_pool2d(color, 3, 1, 1)
    color = torch.where(chance(0.3), blurred, color)
    color = (grey + vivid * (color - grey)).clamp(1e-3, 1) ** power
    color = (color * gain + shift + noise).clamp(0, 1)
    depth, read, mask = rest[:, :1], rest[:, 1:2], rest[:, 2:]
    wider = torch.nn.functional.max_pool2d(mask, 3, 1, 1)
    narrower = 1 - torch.nn.functional.max_pool2d(1 - mask, 3, 1, 1)
    mask = torch.where(chance(0.25), wider, torch.where(chance(0.25), narrower, mask))
    coarse = torch.rand(count, 1, 8, 8)
    holes = torch.nn.functional.interpolate(coarse, size=crops.shape[2:], mode="bilinear") > 0.62
    lost = (chance(_HOLES) & holes) | chance(_NO_DEPTH)
    read = torch.where(lost, torch.zeros_like(read), read)
    depth = torch.where(lost, torch.full_like(depth, 128 / 255), depth)
    return torch.cat([color, depth, read, mask], 1)


def predict_looks(network: Any, crops: EndCrops, batch: int = 256) -> list[EndLook]:
    """Return what the network says of crops, the mean of each and its mirror image."""
    import torch

    looks: list[EndLook] = []
    with torch.no_grad():
        for start in range(0, len(crops.planes), batch):
            planes = _scaled(crops.planes[start : start + batch])
            shapes = torch.from_numpy(crops.shapes[start : start + batch])
            mean = (network(planes, shapes) + network(planes.flip(2), shapes)) / 2
            looks += [looked_at(row) for row in mean.numpy().astype(np.float64)]
    return looks


def train_look(
    crops: EndCrops, init: Path | str, out: Path, options: LookOptions | None = None
) -> LookResult:
    """Train the network, export it to ONNX, and judge it by the held-out scenes.

    Parameters
    ----------
    crops : EndCrops
        Of `collect_end_crops`.
    init : Path
        Checkpoint (.pt) of YOLO26n to begin with.
    out : Path
        The ONNX file to write.
    options : LookOptions, optional
        Options of training.

    Raises
    ------
    MissingExtraError
        If the extra `train` is not installed.
    ModelError
        If the checkpoint cannot be loaded.
    """
    network = fit_look(crops, init, options or LookOptions())
    export_look(network, out)
    return judge_look(network, crops, out)


def judge_look(network: Any, crops: EndCrops, out: Path) -> LookResult:
    """Return how well a network tells the held-out ends apart."""
    ends = crops.only(crops.held_out & ~crops.moved & ~np.isnan(crops.missing))
    looks = predict_looks(network, ends)
    covered = np.array([look.covered for look in looks])
    outer = np.array([(look.missing[0], look.missing[-1]) for look in looks]).reshape(-1, 2)
    inside = (outer[:, 0] <= ends.missing) & (ends.missing <= outer[:, 1])
    stem = np.array([look.stem > 0.5 for look in looks]) == (ends.stem > 0.5)
    return LookResult(
        out,
        int((~crops.held_out).sum()),
        len(looks),
        area_under_curve(covered, ends.state == STATES.index("covered")),
        float(inside.mean()) if looks else float("nan"),
        float(stem.mean()) if looks else float("nan"),
    )


def export_look(network: Any, out: Path) -> None:
    """Export the network to ONNX, with weights in half precision."""
    import torch

    inputs = {"crops": torch.zeros(2, PLANES, END_PX, END_PX), "shapes": torch.zeros(2, 2)}
    export_network(network.eval(), out, inputs, "looks", "look")


def write_look_card(
    result: LookResult,
    name: str,
    init: Path | str,
    *,
    epochs: int,
    seed: int,
    credits: Sequence[str] = (),
) -> ModelCard:
    """Write the model card next to the network.

    Parameters
    ----------
    result : LookResult
        Result of `train_look`.
    name : str
        Name of the network.
    init : Path
        The checkpoint it began with.
    epochs, seed : int
        Training options to record.
    credits : sequence of str
        Publishers of training pictures.
    """
    return classifier_card(
        result.network,
        name,
        "look",
        init,
        epochs=epochs,
        seed=seed,
        metrics={
            "crops learnt from": float(result.train_count),
            "ends of other scenes judged by": float(result.val_count),
            "covered ends told from others, area under the curve": result.covered_auc,
            "missing length between the outer quantiles": result.quantiles_hold,
            "stem and blossom ends told right": result.stem_right,
        },
        credits=credits,
        limits=_LIMITS,
    )


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
