"""Train the network that looks at each fruit: its outline, its keypoints, and whether it is one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cucumbervision.fruit.crops import HEIGHT_PX, PLANES, WIDTH_PX
from cucumbervision.networks import DEFAULT_CONFIDENCE
from cucumbervision_lab.arrays import Array, Array32, Mask
from cucumbervision_lab.train import classifier
from cucumbervision_lab.train.end_look import area_under_curve, with_planes
from cucumbervision_lab.train.fruit_crops import SURROUND_PX, Crops

POINTS = 5
_LIMITS = (
    "Trained on what the packaged detector proposes; other detectors make other mistakes.",
    "Most fruit that it learnt from are drawn or lie before plain backgrounds.",
)
_WIDTHS = (48, 32, 16, 8)  # channels of the outline at strides 8, 4, 2 and 1
_ENDS = 4  # columns that the classification sees
_TURN_RAD, _SCALE, _SHIFT = 0.12, 0.15, 0.05  # largest random changes of a crop
_BENT, _BEND_RAD, _MOST_BENT_RAD = 0.4, 1.2, 3.6  # share of crops that are bent, and how much
_LENGTH_PX, _GIRTH_PX = WIDTH_PX / 1.45, 45.0  # a fruit's in its crop
_EDGE_WEIGHT = 4.0  # of an outline's own pixels
_POINT_SCALE_PX = 4.0  # errors of keypoints above it count linearly
_REPEATS = 4  # of false detections near the threshold or above it: few, and what it is for
_AT_ONCE = 128  # crops
_INNER = tuple(
    slice((around - size) // 2, (around + size) // 2)
    for around, size in zip(SURROUND_PX, (HEIGHT_PX, WIDTH_PX), strict=True)
)


def _block(into: int, out: int) -> Any:
    from torch import nn

    return nn.Sequential(
        nn.Conv2d(into, out, 3, padding=1, bias=False), nn.BatchNorm2d(out), nn.SiLU()
    )


def make_network(init: Path | str) -> Any:
    """Build the network: the first layers of YOLO26n on six planes, and a decoder.

    Parameters
    ----------
    init : Path
        As in `first_layers`.

    Returns
    -------
    torch.nn.Module
        Input: crops, float32 of shape (N, 6, 112, 256), range 0 to 1. Outputs: log-odds of the
        outline, (N, 112, 256); keypoints from left to right, (N, 5, 3): x, y in pixels and log-odds
        of being visible; log-odds that it is a cucumber and that its stem end is the right one,
        (N, 2).
    """
    import torch
    from torch import nn
    from torch.nn.functional import interpolate

    class FruitNetwork(nn.Module):  # type: ignore[misc]
        """Outline, keypoints and class of one fruit."""

        def __init__(self) -> None:
            super().__init__()
            layers = [layer.float() for layer in classifier.first_layers(init)]
            layers[0].conv = with_planes(layers[0].conv)
            self.stages = nn.ModuleList(
                nn.Sequential(*part) for part in (layers[:1], layers[1:3], layers[3:5], layers[5:])
            )
            w8, w4, w2, w1 = _WIDTHS
            self.context = nn.Linear(classifier.CHANNELS * _ENDS, w8)
            self.reduced = nn.ModuleList(
                nn.Conv2d(*pair, 1)
                for pair in ((classifier.CHANNELS, w8), (128, w8), (64, w4), (16, w2))
            )
            self.upward = nn.ModuleList(
                _block(*pair) for pair in ((w8, w8), (w8, w4), (w4, w2), (w2, w1))
            )
            self.outline = nn.Sequential(_block(w1 + PLANES, w1), nn.Conv2d(w1, 1, 1))
            self.points = nn.Sequential(_block(w8, w8), nn.Conv2d(w8, POINTS * 4, 1))
            self.verdict = nn.Sequential(
                nn.Dropout(0.2),
                nn.Linear(classifier.CHANNELS * _ENDS, 64),
                nn.SiLU(),
                nn.Linear(64, 2),
            )
            self.stem = nn.Sequential(
                nn.AvgPool2d((HEIGHT_PX // 16, 1)),
                nn.Flatten(),
                nn.Dropout(0.2),
                nn.Linear(classifier.CHANNELS * WIDTH_PX // 16, 1),
            )
            rows, columns = HEIGHT_PX // 8, WIDTH_PX // 8
            y, x = torch.meshgrid(
                8 * torch.arange(rows) + 3.5, 8 * torch.arange(columns) + 3.5, indexing="ij"
            )
            self.register_buffer("places", torch.stack([x, y]).reshape(1, 1, 2, -1))

        def forward(self, crops: Any) -> Any:
            s2 = self.stages[0](crops)
            s4 = self.stages[1](s2)
            s8 = self.stages[2](s4)
            s16 = self.stages[3](s8)
            ends = nn.functional.avg_pool2d(s16, (HEIGHT_PX // 16, WIDTH_PX // 16 // _ENDS))
            ends = ends.flatten(1)
            coarse = self.reduced[0](s16) + self.context(ends)[:, :, None, None]
            h8 = self.upward[0](interpolate(coarse, scale_factor=2.0) + self.reduced[1](s8))
            h4 = interpolate(self.upward[1](h8), scale_factor=2.0, mode="bilinear")
            h2 = self.upward[2](h4 + self.reduced[2](s4))
            h2 = interpolate(h2, scale_factor=2.0, mode="bilinear") + self.reduced[3](s2)
            h1 = interpolate(self.upward[3](h2), scale_factor=2.0, mode="bilinear")
            outline = self.outline(torch.cat([h1, crops], 1))[:, 0]
            maps = self.points(h8).reshape(-1, POINTS, 4, self.places.shape[-1])
            share = maps[:, :, :1].float().softmax(-1)
            moved = torch.cat([self.places + 16 * maps[:, :, 1:3], maps[:, :, 3:]], 2)
            points = (share * moved).sum(-1)
            verdict = self.verdict(ends)
            stem = verdict[:, 1:] + self.stem(s16)
            return outline, points, torch.cat([verdict[:, :1], stem], 1)

    return FruitNetwork().requires_grad_(True)


def fit_fruit(crops: Crops, init: Path | str, options: classifier.ClassifierOptions) -> Any:
    """Train the network.

    Parameters
    ----------
    crops : recarray of FRUIT_CROP
        Of `collect_fruit_crops`; those held out are not learnt from.
    init : Path
        Checkpoint (.pt) of YOLO26n, or of this network.
    options : ClassifierOptions
        Options of training.
    """
    proposed = (crops.is_fruit == 0) & (crops.confidence > DEFAULT_CONFIDENCE / 2)
    learnt = np.repeat(np.arange(len(proposed)), np.where(proposed, _REPEATS, 1))
    learnt = learnt[~crops.held_out[learnt]]
    cpu_info = Path("/proc/cpuinfo")
    flags = cpu_info.read_text(encoding="utf-8") if cpu_info.is_file() else ""
    has_bfloat16 = "avx512_bf16" in flags  # emulated, it is slower than float32

    def loss_of(network: Any, chosen: NDArray[np.intp]) -> Any:
        import torch

        batch = as_batch(crops, learnt[chosen])
        planes, *truth = augmented(*batch)
        with torch.autocast("cpu", torch.bfloat16, enabled=has_bfloat16):
            answer = network(planes.contiguous(memory_format=torch.channels_last))
        return loss(tuple(part.float() for part in answer), *truth)

    return classifier.fit(
        lambda: classifier.begun_network(init, make_network), len(learnt), loss_of, options
    )


def as_batch(crops: Crops, rows: NDArray[np.intp]) -> tuple[Any, ...]:
    """Return crops as tensors: planes and outline in 0 to 1, and what is known of them."""
    import torch

    planes = np.concatenate([crops.planes[rows], crops.outlines[rows][..., None]], 3)
    truth = (crops.has_outline, crops.points, crops.visible, crops.stem, crops.is_fruit)
    return classifier.scaled_planes(planes), *(torch.from_numpy(part[rows]) for part in truth)


def loss(
    answer: Any, outline: Any, has_outline: Any, points: Any, visible: Any, stem: Any, is_fruit: Any
) -> Any:
    """Return the loss: outline, keypoints, their visibility, class and stem end, where labelled."""
    import torch
    from torch.nn.functional import binary_cross_entropy_with_logits as cross_entropy
    from torch.nn.functional import max_pool2d, smooth_l1_loss

    drawn, placed, verdict = answer
    total = torch.zeros(())
    if has_outline.any():
        logits, target = drawn[has_outline], outline[has_outline]
        edge = max_pool2d(target, 5, 1, 2) + max_pool2d(1 - target, 5, 1, 2) - 1
        total = total + 4 * cross_entropy(logits, target, weight=1 + _EDGE_WEIGHT * edge)
        inside, area = logits.sigmoid(), target.sum((1, 2))
        overlap = 2 * (inside * target).sum((1, 2)) / (inside.sum((1, 2)) + area + 1)
        total = total + (1 - overlap)[area > 0].sum() / max(len(area), 1)
    pointed = ~points.isnan().any(-1)
    if pointed.any():
        off = smooth_l1_loss(
            placed[..., :2][pointed], points[pointed], beta=_POINT_SCALE_PX, reduction="none"
        )
        total = total + off.mean() / 8
    labelled = ~visible.isnan()
    if labelled.any():
        total = total + 0.2 * cross_entropy(placed[..., 2][labelled], visible[labelled])
    for column, target in enumerate((is_fruit, stem)):
        labelled = ~target.isnan()
        if labelled.any():
            smooth = 0.02 + 0.96 * target[labelled]
            total = total + cross_entropy(verdict[labelled, column], smooth)
    return total


def augmented(
    planes: Any, has_outline: Any, points: Any, visible: Any, stem: Any, is_fruit: Any
) -> tuple[Any, ...]:
    """Turn, scale, move and mirror crops at random, cut them to size, and change their light."""
    import torch

    planes, points, visible, stem = moved(planes, points, visible, stem)
    side_px = 2 * int(torch.randint(1, 4, ())) + 1
    light = shade(len(planes))
    changed = classifier.changed_planes(
        planes[:, :6], 0.25, no_depth=0.25, side_px=side_px, shade=light
    )
    return changed, planes[:, 6], has_outline, points, visible, stem, is_fruit


def moved(planes: Any, points: Any, visible: Any, stem: Any) -> tuple[Any, ...]:
    """Return crops turned, scaled, moved, mirrored and bent at random, with their keypoints."""
    import torch
    from torch.nn.functional import grid_sample

    count = len(planes)

    def spread(limit: float) -> Any:
        return limit * (2 * torch.rand(count) - 1)

    def side() -> Any:
        return torch.where(torch.rand(count) < 0.5, 1.0, -1.0)

    bend = (torch.randn(count).abs() * _BEND_RAD).clamp(max=_MOST_BENT_RAD)
    curvature = torch.where(torch.rand(count) < _BENT, side() * bend, 0.0) / _LENGTH_PX
    size_bent, sag = _bent_extent(curvature)
    angle, size, flip_x, flip_y = spread(_TURN_RAD), 1 + spread(_SCALE), side(), side()
    shift = torch.stack([WIDTH_PX * spread(_SHIFT), WIDTH_PX * spread(_SHIFT / 2) + sag], -1)
    # A pixel p of the result, from its middle, shows the point turn @ p + shift of the bent crop.
    cos, sin = size * size_bent * angle.cos(), size * size_bent * angle.sin()
    rows = [[flip_x * cos, -flip_y * sin], [flip_x * sin, flip_y * cos]]
    turn = torch.stack([torch.stack(row, -1) for row in rows], 1)
    middle = torch.tensor([WIDTH_PX - 1, HEIGHT_PX - 1]) / 2
    y, x = torch.meshgrid(torch.arange(HEIGHT_PX), torch.arange(WIDTH_PX), indexing="ij")
    pixels = torch.stack([x, y], -1).reshape(1, -1, 2) - middle
    bent = torch.einsum("nij,mkj->nki", turn, pixels) + shift[:, None]
    half_in = torch.tensor([SURROUND_PX[1], SURROUND_PX[0]]) / 2
    grid = (straightened(bent, curvature) / half_in).reshape(count, HEIGHT_PX, WIDTH_PX, 2)
    sampled = grid_sample(planes, grid, padding_mode="reflection", align_corners=False)
    sampled[:, 4:6] = (sampled[:, 4:6] > 0.5).float()
    placed = bent_points(points - middle, curvature) - shift[:, None]
    points = torch.einsum("nij,nkj->nki", torch.linalg.inv(turn), placed) + middle
    turned = flip_x < 0
    points = torch.where(turned[:, None, None], points.flip(1), points)
    visible = torch.where(turned[:, None], visible.flip(1), visible)
    return sampled, points, visible, torch.where(turned, 1 - stem, stem)


def _bent_extent(curvature: Any) -> tuple[Any, Any]:
    """Return the crop's step and the fruit's middle across, after bending."""
    import torch

    half = curvature.abs() * _LENGTH_PX / 2
    radius = 1 / curvature.abs().clamp(min=1e-6)
    width = torch.where(half < torch.pi / 2, 2 * radius * half.sin(), 2 * radius)
    sag = torch.where(curvature == 0, 0.0, radius * (1 - half.cos()))
    step = torch.maximum(width / _LENGTH_PX, 1.6 * (sag + _GIRTH_PX) / HEIGHT_PX)
    return torch.where(curvature == 0, 1.0, step), curvature.sign() * sag / 2


def bent_points(points: Any, curvature: Any) -> Any:
    """Return points, (N, K, 2) from the crop's middle, after the horizontal axis became an arc."""
    import torch

    k = torch.where(curvature.abs() < 1e-6, 1e-6, curvature)[:, None]
    along, across = points[..., 0] * k, 1 / k - points[..., 1]
    return torch.stack([across * along.sin(), 1 / k - across * along.cos()], -1)


def straightened(points: Any, curvature: Any) -> Any:
    """Return the points that `bent_points` moves to the given ones."""
    import torch

    k = torch.where(curvature.abs() < 1e-6, 1e-6, curvature)[:, None]
    x, below = points[..., 0] * k.sign(), (1 / k - points[..., 1]) * k.sign()
    along, radius = torch.atan2(x, below) / k, torch.hypot(x, below)
    return torch.stack([along, 1 / k - k.sign() * radius], -1)


def shade(count: int) -> Any:
    """Return factors for pictures, brighter to one side: many an end lies in the shade."""
    import torch

    slope = 0.7 * torch.randn(count, 2, 1, 1)
    x, y = torch.linspace(-1, 1, WIDTH_PX), torch.linspace(-1, 1, HEIGHT_PX)
    along = slope[:, :1] * x[None, None, None, :] + 0.5 * slope[:, 1:] * y[None, None, :, None]
    return along.exp().clamp(0.25, 2.0)


def predict_fruit(network: Any, crops: Crops) -> tuple[Array32, ...]:
    """Return outlines, keypoints and verdicts of the middle parts of crops.

    As in use, each is the mean for a crop and the same turned by half a turn.
    """
    import torch

    size = torch.tensor([WIDTH_PX - 1, HEIGHT_PX - 1, 0.0])
    sign, opposite = torch.tensor([-1.0, -1.0, 1.0]), torch.tensor([1.0, -1.0])
    answers = []
    with torch.no_grad():
        for rows in np.array_split(np.arange(len(crops)), len(crops) // _AT_ONCE + 1):
            planes = as_batch(crops, rows)[0][:, :PLANES, *_INNER]
            outline, points, verdict = network(planes)
            turned_outline, turned_points, turned_verdict = network(planes.flip(2, 3))
            pairs = (
                (outline, turned_outline.flip(1, 2)),
                (points, (size + sign * turned_points).flip(1)),
                (verdict, opposite * turned_verdict),
            )
            answers.append([((ahead + back) / 2).numpy() for ahead, back in pairs])
    first, second, third = (np.concatenate(parts) for parts in zip(*answers, strict=True))
    return first, second, third


def judge_fruit(network: Any, crops: Crops, out: Path) -> classifier.Trained:
    """Return how well a network does on the held-out crops."""
    held = crops[crops.held_out]
    outlines, points, verdicts = predict_fruit(network, held)
    fruit = (held.is_fruit == 1) & held.has_outline
    truth = held.outlines[fruit][:, *_INNER] > 127
    coarse = held.planes[fruit][:, *_INNER, 5] > 127
    pointed = (held.is_fruit == 1) & ~np.isnan(held.points).any((1, 2))
    off = np.linalg.norm(points[pointed][..., :2] - held.points[pointed], axis=-1)
    length = np.linalg.norm(np.diff(held.points[pointed], axis=1), axis=-1).sum(1)
    directed = ~np.isnan(held.stem) & (held.is_fruit == 1)
    right = (verdicts[directed, 1] > 0) == (held.stem[directed] == 1)
    judged = ~np.isnan(held.is_fruit)
    metrics = {
        classifier.LEARNT_FROM: float((~crops.held_out).sum()),
        "crops of other scenes judged by": float(len(held)),
        "IoU of the detector's masks, median": _median(_ious(coarse, truth)),
        "IoU of the network's outlines, median": _median(_ious(outlines[fruit] > 0, truth)),
        "error of an end relative to the length, median": _median(
            off[:, [0, -1]] / length[:, None]
        ),
        "fruit told from others, area under the curve": area_under_curve(
            verdicts[judged, 0].astype(np.float64), held.is_fruit[judged] == 1
        ),
        "stem ends told right": float(right.mean()) if right.size else float("nan"),
    }
    return classifier.Trained(out, "fruit", _LIMITS, metrics)


def _median(values: NDArray[Any]) -> float:
    return float(np.median(values)) if values.size else float("nan")


def _ious(masks: Mask, truth: Mask) -> Array:
    both = (masks & truth).sum((1, 2))
    return np.asarray(both / np.maximum((masks | truth).sum((1, 2)), 1))


def train_fruit(
    crops: Crops, init: Path | str, out: Path, options: classifier.ClassifierOptions
) -> classifier.Trained:
    """Train the network, export it to ONNX, and judge it by the held-out scenes.

    Parameters
    ----------
    crops : recarray of FRUIT_CROP
        Of `collect_fruit_crops`.
    init : Path
        Checkpoint (.pt) of YOLO26n, or of this network, to begin with.
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

    network = fit_fruit(crops, init, options)
    crop = {"crops": torch.zeros(2, PLANES, HEIGHT_PX, WIDTH_PX)}
    classifier.export_network(network, out, crop, ("outline", "points", "verdict"), "fruit")
    return judge_fruit(network, crops, out)
