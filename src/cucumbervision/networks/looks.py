"""Small networks that look at single fruit and ends, at the camera's own resolution.

A detector sees the picture at 640 pixels and draws masks on a quarter of them; a crop of one
detection shows the fruit as the camera did: its outline, its keypoints, what it is. Depth shows an
object beside an end, but not whether the fruit continues behind it: leaves and stems hang at nearly
the same distance. A crop around each end of a measured axis, turned so that the fruit always comes
from the left, decides whether it is the true end, and what is missing.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from scipy.special import expit, logit

from cucumbervision.errors import ModelError
from cucumbervision.fruit.crops import (
    END_PX,
    HEIGHT_PX,
    PLANES,
    WIDTH_PX,
    EndCrop,
    EndLook,
    fruit_crop,
)
from cucumbervision.fruit.instance import UNKNOWN_ORDER, visible_mask, with_disjoint_masks
from cucumbervision.fruit.masks import mask_iou, without_spurs
from cucumbervision.networks.resize import input_planes
from cucumbervision.networks.runtime import open_network, runtime_for_batches

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from cucumbervision.fruit.crops import FruitCrop
    from cucumbervision.fruit.instance import Instance


class SmallNetwork:
    """A network so small that ONNX Runtime runs it fastest.

    Parameters
    ----------
    path : Path
        An ONNX file as the class's `command` writes it.
    runtime : str
        As for `open_network`, and as `runtime_for_batches` changes it.

    Raises
    ------
    ModelError
        If the file cannot be loaded or is another kind of network.
    """

    shapes: ClassVar[tuple[tuple[int, ...], ...]]
    """Shape of each input, without the number of pictures; the first input is the pictures."""

    takes: ClassVar[str]
    """What the pictures show, for the error."""

    command: ClassVar[str]
    """The command that trains such a network, for the error."""

    outputs: ClassVar[int] = 1
    """Number of outputs."""

    def __init__(self, path: Path, runtime: str = "auto") -> None:
        chosen = runtime_for_batches(runtime)
        self._network = open_network(path, chosen, full_precision=True)
        self.runtime = self._network.runtime
        inputs = tuple(tuple(tensor.shape[1:]) for tensor in self._network.inputs)
        if inputs != self.shapes or len(self._network.outputs) != self.outputs:
            raise ModelError(
                f"takes {list(inputs)}, not {self.takes}",
                source=path,
                remedy=f"name a network by `cucumbervision {self.command}`",
            )

    def _run(
        self, pictures: NDArray[np.uint8], *values: NDArray[np.float32]
    ) -> dict[str, NDArray[np.float32]]:
        """Return the outputs by name for pictures (N, H, W, C) and the values of other inputs."""
        names = [tensor.name for tensor in self._network.inputs]
        return self._network.run(dict(zip(names, (input_planes(pictures), *values), strict=True)))


LEAST_AGREEMENT = 0.6
"""IoU of a new outline with the detector's mask below which the detector's stays."""


_RAISING, _LOWERING = 0.4, 0.8
"""Of the network's log-odds beside the detector's, both of which saw much the same pictures."""

_EVEN = 1.0
"""The network's log-odds that change no confidence: few of its crops show no fruit."""


@dataclass(frozen=True, eq=False)
class FruitLook:
    """The network's output for one crop.

    Parameters
    ----------
    outline : ndarray of float32, shape (HEIGHT_PX, WIDTH_PX)
        Log-odds that a pixel of the crop shows the fruit.
    points : ndarray of float64, shape (5, 3)
        Keypoints in order of the crop's columns: x and y in its pixels, and the probability of
        being visible.
    fruit, stem_last : float
        Log-odds that it is a cucumber, and that the last keypoint is the stem end.
    """

    outline: NDArray[np.float32]
    points: NDArray[np.float64]
    fruit: float
    stem_last: float

    def turned(self) -> FruitLook:
        """Convert a look at a crop turned by half a turn to the crop before it was turned."""
        points = self.points[::-1].copy()
        points[:, :2] = (WIDTH_PX - 1, HEIGHT_PX - 1) - points[:, :2]
        return FruitLook(self.outline[::-1, ::-1], points, self.fruit, -self.stem_last)


class FruitLooker(SmallNetwork):
    """Looks at detected fruit.

    Parameters and errors are those of `SmallNetwork`.
    """

    shapes = ((PLANES, HEIGHT_PX, WIDTH_PX),)
    takes = "crops of fruit"
    command = "train classifier fruit"
    outputs = 3

    def look(self, crops: Sequence[FruitCrop], *, once: bool = False) -> list[FruitLook]:
        """Return the network's output for crops, computed in one batch.

        Each look is the mean for the crop and for the crop turned by half a turn. A crop and the
        turned one thus get the same outline, and exactly opposite stem ends.

        Parameters
        ----------
        crops : sequence of FruitCrop
            The crops.
        once : bool
            Whether to leave the turned crops out: half the time, and less accurate.
        """
        if not crops:
            return []
        planes = np.stack([crop.planes for crop in crops])
        if once:
            return self._answers(planes)
        answers = self._answers(np.concatenate([planes, planes[:, ::-1, ::-1]]))
        pairs = zip(answers[: len(crops)], answers[len(crops) :], strict=True)
        return [_mean(ahead, back.turned()) for ahead, back in pairs]

    def _answers(self, planes: NDArray[np.uint8]) -> list[FruitLook]:
        answers = self._run(planes)
        outlines, points, verdicts = (
            np.asarray(answers[name], np.float32) for name in ("outline", "points", "verdict")
        )
        points[..., 2] = expit(points[..., 2])
        return [
            FruitLook(outline, place.astype(np.float64), *verdict.tolist())
            for outline, place, verdict in zip(outlines, points, verdicts, strict=True)
        ]


@dataclass(eq=False)
class PictureLooks:
    """Looks at the fruit of one picture, each mask once.

    Parameters
    ----------
    looker : FruitLooker
        The network.
    color_rgb : ndarray of uint8, shape (H, W, 3)
        The picture.
    depth_m : ndarray of float32, shape (H, W), optional
        Metres, aligned to colour.
    focal_px : float, optional
        Focal length of the colour camera, pixels; without it depth is not shown.
    once : bool
        Whether one look at each fruit is enough; see `FruitLooker.look`.
    """

    looker: FruitLooker
    color_rgb: NDArray[np.uint8]
    depth_m: NDArray[np.float32] | None = None
    focal_px: float | None = None
    once: bool = False
    # With each mask, so that no other gets its number.
    _done: dict[int, tuple[NDArray[np.bool_], FruitCrop, FruitLook]] = field(default_factory=dict)

    def rescore(self, instances: Sequence[Instance]) -> tuple[Instance, ...]:
        """Return detections with confidences that say what their crops show, too.

        Parameters
        ----------
        instances : sequence of Instance
            Those without `detector_mask` stay as they are.
        """
        looks = self._looks(instances)
        return tuple(
            replace(instance, confidence=rescored(instance.confidence, looks[number][1].fruit))
            if number in looks
            else instance
            for number, instance in enumerate(instances)
        )

    def refine(self, instances: Sequence[Instance]) -> tuple[Instance, ...]:
        """Return detections with the network's outlines and keypoints.

        Parameters
        ----------
        instances : sequence of Instance
            Those without `detector_mask` stay as they are.

        Returns
        -------
        tuple of Instance
            In the same order, without common pixels. An outline that differs much from the
            detector's mask is not taken.
        """
        looks = self._looks(instances)
        masks = [instance.detector_mask for instance in instances]
        refined_instances = list(instances)
        for number, (crop, look) in looks.items():
            neighbours = [mask for k, mask in enumerate(masks) if k != number and mask is not None]
            refined_instances[number] = refined(instances[number], crop, look, neighbours)
        return with_disjoint_masks(refined_instances, self.depth_m)

    def order(self, instances: Sequence[Instance]) -> tuple[Instance, ...]:
        """Return detections with their keypoints ordered from blossom end to stem end.

        Parameters
        ----------
        instances : sequence of Instance
            Those without a mask, without keypoints, or with keypoints whose order is known, stay
            as they are.
        """
        unordered = {
            number: instance
            for number, instance in enumerate(instances)
            if instance.keypoints is not None and instance.end_confidence == UNKNOWN_ORDER
        }
        looks = self._looks([replace(x, detector_mask=visible_mask(x)) for x in unordered.values()])
        ordered = list(instances)
        for place, (number, instance) in enumerate(unordered.items()):
            if place in looks:
                ordered[number] = stem_last(instance, *looks[place])
        return tuple(ordered)

    def _looks(self, instances: Sequence[Instance]) -> dict[int, tuple[FruitCrop, FruitLook]]:
        """Return crops and looks at them, by number, of instances with a mask."""
        masks = {k: x.detector_mask for k, x in enumerate(instances) if x.detector_mask is not None}
        new = {id(mask): mask for mask in masks.values() if id(mask) not in self._done}
        crops = {
            key: crop
            for key, mask in new.items()
            if (crop := fruit_crop(self.color_rgb, self.depth_m, mask, self.focal_px))
        }
        looks = self.looker.look(list(crops.values()), once=self.once)
        for (key, crop), look in zip(crops.items(), looks, strict=True):
            self._done[key] = new[key], crop, look
        return {k: self._done[id(mask)][1:] for k, mask in masks.items() if id(mask) in self._done}


def _mean(first: FruitLook, second: FruitLook) -> FruitLook:
    pairs = zip(vars(first).values(), vars(second).values(), strict=True)
    return FruitLook(*((a + b) / 2 for a, b in pairs))


def rescored(confidence: float, log_odds: float) -> float:
    """Return a detection's confidence after the look at its crop.

    Parameters
    ----------
    confidence : float
        Of the detector, 0 to 1.
    log_odds : float
        Of the network, for a cucumber.

    Examples
    --------
    >>> round(rescored(0.2, 1.0), 3), round(rescored(0.2, 4.0), 3), round(rescored(0.2, -4.0), 3)
    (0.2, 0.454, 0.005)
    """
    detected, shown = logit(np.clip(confidence, 1e-6, 1 - 1e-6)), log_odds - _EVEN
    return float(expit(detected + (_RAISING if shown > 0 else _LOWERING) * shown))


def refined(
    instance: Instance,
    crop: FruitCrop,
    look: FruitLook,
    neighbours: Sequence[NDArray[np.bool_]] = (),
) -> Instance:
    """Return a detection with the outline and the keypoints of a look at it.

    Parameters
    ----------
    instance : Instance
        With `detector_mask`.
    crop : FruitCrop
        Its crop.
    look : FruitLook
        The network's output for the crop.
    neighbours : sequence of ndarray of bool, shape (H, W)
        Masks of other fruit, whose pixels stay theirs.
    """
    mask = instance.detector_mask
    if mask is not None:
        shown = np.where(without_spurs(look.outline > 0), look.outline, -np.abs(look.outline))
        outline = crop.mask_in_picture(shown, (mask.shape[0], mask.shape[1]))
        for neighbour in neighbours:
            outline &= ~neighbour
        mask = outline if mask_iou(outline, mask) >= LEAST_AGREEMENT else mask
    points = np.column_stack([crop.to_picture(look.points[:, :2]), look.points[:, 2]])
    return stem_last(replace(instance, detector_mask=mask, keypoints=points), crop, look)


def stem_last(instance: Instance, crop: FruitCrop, look: FruitLook) -> Instance:
    """Return a detection with its keypoints ordered from blossom end to stem end, and how surely.

    Parameters
    ----------
    instance : Instance
        With keypoints along the fruit, from either end.
    crop : FruitCrop
        Its crop.
    look : FruitLook
        The network's output for the crop.
    """
    points = instance.keypoints
    if points is None:
        return instance
    run = np.diff(crop.to_crop(points[[0, -1], :2])[:, 0])[0]
    points = points if (run >= 0) == (look.stem_last >= 0) else points[::-1].copy()
    sure = float(expit(abs(look.stem_last)))
    return replace(instance, keypoints=points, end_confidence=sure)


STATES = ("true", "covered", "running on")
"""What an end may be, in the order of the network's output."""

ERROR_SCALE = 0.02
"""Of the length: the network's quantiles are asinh(share / ERROR_SCALE), fine near zero."""


class EndLooker(SmallNetwork):
    """Evaluates the ends of fruit.

    Parameters and errors are those of `SmallNetwork`.
    """

    shapes = ((PLANES, END_PX, END_PX), (2,))
    takes = "crops of ends"
    command = "train classifier look"

    def look(self, crops: Sequence[EndCrop]) -> list[EndLook]:
        """Return the evaluation of ends, computed in one batch.

        Parameters
        ----------
        crops : sequence of EndCrop
            Results of `end_crop`. The outputs of each crop and its mirror image are averaged.
        """
        if not crops:
            return []
        planes = np.stack([crop.planes for crop in crops])
        shapes = np.tile(np.array([crop.shape for crop in crops], np.float32), (2, 1))
        (rows,) = self._run(np.concatenate([planes, planes[:, ::-1]]), shapes).values()
        mean = np.asarray(rows, np.float64).reshape(2, len(crops), -1).mean(axis=0)
        return [looked_at(row) for row in mean]


def looked_at(row: NDArray[np.float64]) -> EndLook:
    """Convert the network's output for one end.

    Parameters
    ----------
    row : ndarray of float64, shape (9,)
        Logits of the `STATES`, quantiles as asinh(share / `ERROR_SCALE`), and the logit of the
        stem end.

    Examples
    --------
    >>> look = looked_at(np.array([0.0, 0, 0, -1, 0, 0, 1, 5, 0]))
    >>> round(look.covered, 2), [round(share, 3) for share in look.missing], look.stem
    (0.33, [-0.024, 0.0, 0.0, 0.024, 1.484], 0.5)
    """
    states = np.exp(row[:3] - row[:3].max())
    true, covered, running_on = (states / states.sum()).tolist()
    shares = np.sort(ERROR_SCALE * np.sinh(row[3:8]))
    return EndLook(
        true=true,
        covered=covered,
        running_on=running_on,
        missing=tuple(shares.tolist()),
        stem=float(1 / (1 + np.exp(-row[8]))),
    )
