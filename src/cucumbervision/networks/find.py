"""Find the fruit of an image: the networks of a run, loaded once, and what they find together.

A detector sees the image at 640 pixels and draws masks on a quarter of them; a crop of one
detection shows the fruit as the camera did: its outline, its keypoints, what it is. Depth shows an
object beside an end, but not whether the fruit continues behind it: leaves and stems hang at nearly
the same distance. A crop around each end of a measured axis, turned so that the fruit always comes
from the left, decides whether it is the true end, and what is missing.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, ClassVar, Protocol, TypeVar

import numpy as np
from scipy.special import expit, logit, softmax

from cucumbervision.arrays import Array, Array32, Mask, Pixels
from cucumbervision.errors import ModelError
from cucumbervision.fruit.crops import (
    END_PX,
    HEIGHT_PX,
    PLANES,
    WIDTH_PX,
    EndCrop,
    EndLook,
    FruitCrop,
    fruit_crop,
)
from cucumbervision.fruit.instance import (
    LEAST_END_CONFIDENCE,
    UNKNOWN_ORDER,
    Instance,
    merge_instances,
    visible_mask,
    with_disjoint_masks,
    with_keypoints,
)
from cucumbervision.fruit.masks import box_ious, mask_iou, without_spurs
from cucumbervision.networks import CANDIDATE_CONFIDENCE, DEFAULT_CONFIDENCE
from cucumbervision.networks.registry import Registry, file_sha256, load_registry
from cucumbervision.networks.runtime import input_planes, open_network, runtime_for_batches
from cucumbervision.networks.yolo import SAME_IOU, YoloDetector, detector_floor, pose_floor
from cucumbervision.plugins import Segmenter


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
    """Shape of each input, without the number of images; the first input is the images."""

    takes: ClassVar[str]
    """What the images show, for the error."""

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

    def _run(self, pictures: Pixels, *values: Array32) -> dict[str, Array32]:
        """Return the outputs by name for images (N, H, W, C) and the values of other inputs."""
        names = [tensor.name for tensor in self._network.inputs]
        return self._network.run(dict(zip(names, (input_planes(pictures), *values), strict=True)))


LEAST_AGREEMENT = 0.6
"""IoU of a new outline with the detector's mask below which the detector's stays."""


_RAISING, _LOWERING = 0.4, 0.8
"""Of the network's log-odds beside the detector's, both of which saw much the same images."""

_FARTHER_PX = 4.0  # of the image: half a pixel of a detector's mask
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

    outline: Array32
    points: Array
    fruit: float
    stem_last: float

    def turned(self) -> FruitLook:
        """Convert a look at a crop turned by half a turn to the crop before it was turned."""
        points = self.points[::-1].copy()
        points[:, :2] = (WIDTH_PX - 1, HEIGHT_PX - 1) - points[:, :2]
        return FruitLook(self.outline[::-1, ::-1], points, self.fruit, -self.stem_last)


class FruitLooker(SmallNetwork):
    """Network that gives outline, keypoints and a score for the crop of one detected fruit.

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

    def _answers(self, planes: Pixels) -> list[FruitLook]:
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
    """Runs a `FruitLooker` on crops of the fruit of one image, once for each mask.

    Parameters
    ----------
    looker : FruitLooker
        The network.
    color_rgb : ndarray of uint8, shape (H, W, 3)
        The image.
    depth_m : ndarray of float32, shape (H, W), optional
        Metres, aligned to colour.
    focal_px : float, optional
        Focal length of the colour camera, pixels; without it depth is not shown.
    once : bool
        Whether the crops turned by half a turn are left out; see `FruitLooker.look`.
    """

    looker: FruitLooker
    color_rgb: Pixels
    depth_m: Array32 | None = None
    focal_px: float | None = None
    once: bool = False
    # With each mask, so that no other gets its number.
    _done: dict[int, tuple[Mask, FruitCrop, FruitLook]] = field(default_factory=dict)

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
    instance: Instance, crop: FruitCrop, look: FruitLook, neighbours: Sequence[Mask] = ()
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
        shown = np.where(_without_stalk(crop, look), look.outline, -np.abs(look.outline))
        outline = crop.mask_in_picture(shown, (mask.shape[0], mask.shape[1]))
        for neighbour in neighbours:
            outline &= ~neighbour
        mask = outline if mask_iou(outline, mask) >= LEAST_AGREEMENT else mask
    points = np.column_stack([crop.to_picture(look.points[:, :2]), look.points[:, 2]])
    return stem_last(replace(instance, detector_mask=mask, keypoints=points), crop, look)


def _without_stalk(crop: FruitCrop, look: FruitLook) -> Mask:
    """Return a look's outline, which at a sure stem end goes little farther than the detector's.

    Examples
    --------
    >>> from cucumbervision.fruit.crops import FruitCrop
    >>> planes = np.zeros((HEIGHT_PX, WIDTH_PX, PLANES), np.uint8)
    >>> planes[40:70, 60:200, -1] = 255
    >>> outline = np.full((HEIGHT_PX, WIDTH_PX), -1.0, np.float32)
    >>> outline[40:70, 40:200] = 1.0
    >>> crop = FruitCrop(planes, np.zeros(2), np.array([1.0, 0.0]), 2.0)
    >>> look = FruitLook(outline, np.zeros((5, 3)), 5.0, -3.0)
    >>> np.flatnonzero(_without_stalk(crop, look).any(axis=0))[[0, -1]].tolist()
    [58, 199]
    """
    outline = without_spurs(look.outline > 0)
    if expit(abs(look.stem_last)) >= LEAST_END_CONFIDENCE:
        to_stem = slice(None, None, 1 if look.stem_last > 0 else -1)
        detected = np.flatnonzero((crop.planes[:, to_stem, -1] > 127).any(axis=0))
        outline[:, to_stem][:, detected.max() + 1 + round(_FARTHER_PX / crop.step_px) :] = False
    return outline


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
    return replace(instance, keypoints=points, end_confidence=float(expit(abs(look.stem_last))))


STATES = ("true", "covered", "running on")
"""What an end may be, in the order of the network's output."""

ERROR_SCALE = 0.02
"""Of the length: the network's quantiles are asinh(share / ERROR_SCALE), fine near zero."""


class EndLooker(SmallNetwork):
    """Network that classifies the end of a fruit in a crop: true, covered or running on.

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


def looked_at(row: Array) -> EndLook:
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
    true, covered, running_on = softmax(row[:3]).tolist()
    return EndLook(
        true=true,
        covered=covered,
        running_on=running_on,
        missing=tuple(np.sort(ERROR_SCALE * np.sinh(row[3:8])).tolist()),
        stem=float(expit(row[8])),
    )


@dataclass(frozen=True)
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

    detector: YoloDetector
    pose: YoloDetector | None = None
    confidence: float = DEFAULT_CONFIDENCE
    fruit: FruitLooker | None = None
    quick: bool = False

    @property
    def labels(self) -> tuple[str, ...]:
        """The detector's class names, in its order; empty if it has none."""
        return tuple(name for _, name in sorted(self.detector.names.items()))

    @property
    def gives_keypoints(self) -> bool:
        """Whether fruit may come with keypoints."""
        from_detector = self.detector.task == "pose"
        return from_detector or self.pose is not None or self.fruit is not None

    def find(
        self, color_rgb: Pixels, depth_m: Array32 | None = None, focal_px: float | None = None
    ) -> tuple[Instance, ...]:
        """Find the fruit of one image, without duplicates.

        Parameters
        ----------
        color_rgb : ndarray of uint8, shape (H, W, 3)
            The image.
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
        detector, pose = self.detector, self.pose
        looks = None
        if self.fruit is not None:
            looks = PictureLooks(self.fruit, color_rgb, depth_m, focal_px, self.quick)
        is_strict = looks is None or self.quick
        floor = None if is_strict else min(CANDIDATE_CONFIDENCE, detector.confidence)
        detections = detector.detect(color_rgb, floor)
        posed = pose.detect(color_rgb) if pose is not None and detections else None
        look = None if looks is None else looks.rescore
        sure, votes = self.confidence, detector.looks
        fruit = each_fruit_once(detections, posed, depth_m, confidence=sure, looks=votes, look=look)
        return fruit if looks is None else looks.refine(fruit)


def each_fruit_once(
    detected: Sequence[Instance],
    posed: Sequence[Instance] | None,
    depth_m: Array32 | None = None,
    *,
    confidence: float = DEFAULT_CONFIDENCE,
    looks: int = 1,
    look: Callable[[Sequence[Instance]], Sequence[Instance]] | None = None,
) -> tuple[Instance, ...]:
    """Merge a detector's and a pose network's detections of one image.

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
        boxes = np.array([pose.box for pose in free]).reshape(-1, 4)
        ious = box_ious(detection.box[None], boxes)[0]
        agrees = ious.size > 0 and ious.max() > SAME_IOU
        vote = free.pop(int(ious.argmax())).confidence if agrees else 0.0
        mean = (looks * detection.confidence + vote) / (looks + 1)
        voted.append(replace(detection, confidence=mean))
    return tuple(sorted(voted, key=lambda detection: -detection.confidence))


class NetworkSegmenter(Segmenter, Protocol):
    """A segmenter of the registry.

    A class with these methods becomes available by an entry in `models.toml` whose `segmenter`
    names it. It is called with the entry's files by role, and with `runtime`, `prompt` and
    `full_precision`.
    """

    prompt: str

    @property
    def runtime(self) -> str:
        """The runtime, as `Network.runtime`."""
        ...

    def mask_at(self, color_rgb: Pixels, u_px: float, v_px: float) -> Mask:
        """Return the mask of the object at one pixel, bool, shape (H, W); may be empty."""
        ...


def open_segmenter(
    name: str | None = None,
    *,
    runtime: str = "auto",
    prompt: str = "box+point",
    full_precision: bool = False,
    registry: Registry | None = None,
) -> NetworkSegmenter:
    """Load a segmenter of the registry.

    Parameters
    ----------
    name : str, optional
        Its name, such as 'mobile-sam'; the default segmenter if not given.
    runtime : str
        As in `open_network`.
    prompt : str
        Kind of prompt: 'box+point', 'box' or 'point'.
    full_precision : bool
        Compute in float32 for reproducible results.
    registry : Registry, optional
        Registry of named networks; by default that of the package.

    Raises
    ------
    ModelError, ModelHashError
        If it is unknown, not on this machine, or a file is missing or damaged.

    Examples
    --------
    >>> from cucumbervision.fruit.instance import Instance
    >>> picture = np.full((120, 160, 3), (120, 80, 50), np.uint8)
    >>> picture[40:80, 30:130] = (40, 140, 50)
    >>> fruit = Instance(np.array([29.5, 39.5, 129.5, 79.5]))
    >>> (segmented,) = open_segmenter("mobile-sam").segment(picture, [fruit])
    >>> segmented.mask_source.value, segmented.mask[60, 80], segmented.mask[100, 80]
    ('sam', np.True_, np.False_)
    """
    loader = NetworkLoader(
        registry or load_registry(), runtime, prompt=prompt, full_precision=full_precision
    )
    return loader.segmenter(name)


Small = TypeVar("Small", FruitLooker, EndLooker)


@dataclass(eq=False)
class NetworkLoader:
    """Loads networks by name from a registry, or from a user's file.

    Parameters
    ----------
    registry : Registry
        The named networks; the package's registry if not given.
    runtime : str
        Runtime, as in `open_network`.
    confidence : float
        Detections below it are omitted.
    prompt : str
        Kind of prompt for SAM.
    full_precision : bool
        Compute in float32.
    most_fruit : int, optional
        Largest number of detections per image.
    input_sizes : tuple of int
        Input sizes (long sides, pixels) of detector and pose network; empty for each file's
        default.

    Attributes
    ----------
    models : list of dict
        Name, task, SHA-256 and runtime of each loaded network.
    fruit_looker, segmenter, verify : callable
        Return the network that looks at each fruit, a segmenter by its name, and a network's
        files by role; each is loaded once.

    Examples
    --------
    >>> loader = NetworkLoader(runtime="onnxruntime")
    >>> loader.segmenter("mobile-sam") is loader.segmenter("mobile-sam")
    True
    >>> [model["name"] for model in loader.models]
    ['mobile-sam']
    """

    registry: Registry = field(default_factory=load_registry)
    runtime: str = "auto"
    confidence: float = DEFAULT_CONFIDENCE
    prompt: str = "box+point"
    full_precision: bool = False
    most_fruit: int | None = None
    input_sizes: tuple[int, ...] = ()
    models: list[dict[str, Any]] = field(default_factory=list, init=False)
    _orders_ends: bool = field(default=False, init=False)

    def __post_init__(self) -> None:
        self.verify = cache(self.registry.resolve)  # each file is hashed once
        self.fruit_looker = cache(partial(self._small_network, "fruit", FruitLooker))
        self._end_looker = cache(partial(self._small_network, "look", EndLooker))
        self.segmenter = cache(self._segmenter)

    def stem_looker(self) -> FruitLooker | None:
        """Return the network that finds the stem end, if a loaded one orders keypoints by place."""
        return self.fruit_looker() if self._orders_ends else None

    @property
    def look_at_ends(self) -> Callable[[Sequence[EndCrop]], list[EndLook]] | None:
        """The function that evaluates crops of ends by the registry's network; None without one.

        The network is loaded with the first crops, which raises ModelError or ModelHashError if its
        file is missing, damaged, or another kind of network.
        """
        return None if self.registry.default("look") is None else self._look

    def _look(self, crops: Sequence[EndCrop]) -> list[EndLook]:
        looker = self._end_looker()
        return [] if looker is None else looker.look(crops)

    def yolo(self, chosen: Path | str, confidence: float | None = None) -> YoloDetector:
        """Load a YOLO network: a user's file (a path), or one of the registry (a name).

        Parameters
        ----------
        chosen : Path or str
            The file or the name.
        confidence : float, optional
            Detections below it are omitted; by default the loader's.

        Raises
        ------
        ModelError, ModelHashError
            If a file is missing, damaged, or not a known kind of network.
        """
        path = self.verify(chosen)["network"] if isinstance(chosen, str) else chosen
        network = YoloDetector(
            path,
            self.runtime,
            self.confidence if confidence is None else confidence,
            full_precision=self.full_precision,
            most_fruit=self.most_fruit,
            input_sizes=self.input_sizes,
        )
        name = chosen if isinstance(chosen, str) else path.name
        self._note(name, network.task, file_sha256(path), network)
        self._orders_ends = self._orders_ends or network.by_place
        return network

    def pose(self, path: Path) -> YoloDetector:
        """Load a user's pose network, for the keypoints of known fruit.

        Raises
        ------
        ModelError
            If the file is missing, or not a YOLO pose network.
        """
        pose = self.yolo(path, pose_floor(self.confidence))
        if pose.task != "pose":
            raise ModelError(
                f"it is a {pose.task} network and gives no keypoints",
                source=path,
                remedy="name a YOLO pose ONNX export with --pose",
            )
        return pose

    def detectors(
        self,
        file: Path | None = None,
        pose: YoloDetector | Path | None = None,
        *,
        quick: bool = False,
        looks: bool = True,
    ) -> Detectors:
        """Load a detector and the network beside it that gives keypoints.

        Parameters
        ----------
        file : Path, optional
            A user's detector; by default the registry's, together with its network that looks at
            each fruit, or else its pose network.
        pose : YoloDetector or Path, optional
            A pose network to use instead of these.
        quick : bool
            As for `Detectors`; without the registry's pose network.
        looks : bool
            Whether the network that looks at each fruit may replace the pose network.

        Raises
        ------
        ModelError, ModelHashError
            If the registry has no detector, or a file is missing, damaged or unknown.
        """
        segment_model, pose_model = self.registry.default("segment"), self.registry.default("pose")
        if file is None and segment_model is None:
            raise ModelError(
                "this version comes without a cucumber detector",
                remedy="name a YOLO ONNX export (--instances FILE)",
            )
        by_look = looks and file is None and pose is None and self.registry.looks_closely
        votes_by_pose = file is None and pose_model is not None and not (by_look or quick)
        least_confidence = detector_floor(self.confidence, votes=votes_by_pose or pose is not None)
        chosen = segment_model.name if file is None and segment_model is not None else file or ""
        detector = self.yolo(chosen, least_confidence)
        if pose is None and votes_by_pose and pose_model is not None:
            pose = self.yolo(pose_model.name, pose_floor(self.confidence))
        elif pose is not None and not isinstance(pose, YoloDetector):
            pose = self.pose(pose)
        fruit = self.fruit_looker() if by_look else None
        return Detectors(detector, pose, self.confidence, fruit, quick)

    def _small_network(self, task: str, kind: Callable[[Path, str], Small]) -> Small | None:
        """Return the registry's small network for a task; None without one.

        Raises
        ------
        ModelError, ModelHashError
            If a file is missing or damaged, or another kind of network.
        """
        model = self.registry.default(task)
        if model is None:
            return None
        network = kind(self.verify(model.name)["network"], self.runtime)
        self._note(model.name, task, model.files[0].sha256, network)
        return network

    def _segmenter(self, name: str | None = None) -> NetworkSegmenter:
        """Return a segmenter of the registry, or the default one.

        Raises
        ------
        ModelError, ModelHashError
            If it is not on this machine, or a file is missing or damaged.
        """
        model = self.registry.segmenter(name)
        how = {"runtime": self.runtime, "full_precision": self.full_precision}
        segmenter: NetworkSegmenter = resolve_name(model.segmenter)(
            self.verify(model.name), prompt=self.prompt, **how
        )
        self._note(model.name, model.task, self.registry.hashes(model.name), segmenter)
        return segmenter

    def _note(self, name: str, task: str, sha256: Any, network: Any) -> None:
        entry = {"name": name, "task": task, "sha256": sha256, "runtime": network.runtime}
        self.models.append(entry)
