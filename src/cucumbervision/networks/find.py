"""Find the fruit of a picture: the networks of a run, loaded once, and what they find together."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cache, partial
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, Protocol, TypeVar, cast

import numpy as np

from cucumbervision.errors import ModelError
from cucumbervision.fruit.instance import merge_instances, with_disjoint_masks, with_keypoints
from cucumbervision.fruit.masks import box_ious
from cucumbervision.networks.confidence import (
    CANDIDATE_CONFIDENCE,
    DEFAULT_CONFIDENCE,
    detector_floor,
    pose_floor,
)
from cucumbervision.networks.looks import EndLooker, FruitLooker, PictureLooks
from cucumbervision.networks.registry import Registry, file_sha256, load_registry
from cucumbervision.networks.yolo import SAME_IOU, YoloDetector
from cucumbervision.plugins import Segmenter

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from cucumbervision.fruit.crops import EndCrop, EndLook
    from cucumbervision.fruit.instance import Instance


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
        self,
        color_rgb: NDArray[np.uint8],
        depth_m: NDArray[np.float32] | None = None,
        focal_px: float | None = None,
    ) -> tuple[Instance, ...]:
        """Find the fruit of one picture, without duplicates.

        Parameters
        ----------
        color_rgb : ndarray of uint8, shape (H, W, 3)
            The picture.
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
        looks, least_confidence = None, None
        if self.fruit is not None:
            looks = PictureLooks(self.fruit, color_rgb, depth_m, focal_px, self.quick)
        if looks is not None and not self.quick:
            least_confidence = min(CANDIDATE_CONFIDENCE, detector.confidence)
        detections = detector.detect(color_rgb, least_confidence)
        posed = pose.detect(color_rgb) if pose is not None and detections else None
        fruit = each_fruit_once(
            detections,
            posed,
            depth_m,
            confidence=self.confidence,
            looks=detector.looks,
            look=None if looks is None else looks.rescore,
        )
        return fruit if looks is None else looks.refine(fruit)


def each_fruit_once(
    detected: Sequence[Instance],
    posed: Sequence[Instance] | None,
    depth_m: NDArray[np.float32] | None = None,
    *,
    confidence: float = DEFAULT_CONFIDENCE,
    looks: int = 1,
    look: Callable[[Sequence[Instance]], Sequence[Instance]] | None = None,
) -> tuple[Instance, ...]:
    """Merge a detector's and a pose network's detections of one picture.

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
        ious = box_ious(detection.box[None], np.array([pose.box for pose in free]).reshape(-1, 4))[
            0
        ]
        agrees = ious.size > 0 and ious.max() > SAME_IOU
        vote = free.pop(int(ious.argmax())).confidence if agrees else 0.0
        voted.append(
            replace(detection, confidence=(looks * detection.confidence + vote) / (looks + 1))
        )
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

    def mask_at(self, color_rgb: NDArray[np.uint8], u_px: float, v_px: float) -> NDArray[np.bool_]:
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
    registry = registry or load_registry()
    model = registry.segmenter(name)
    opened = resolve_name(model.segmenter)(
        registry.resolve(model.name), runtime=runtime, prompt=prompt, full_precision=full_precision
    )
    return cast("NetworkSegmenter", opened)


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
        Largest number of detections per picture.
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
        if isinstance(chosen, str):
            self._note(chosen, network.task, self.registry.hashes(chosen)["network"], network)
        else:
            self._note(path.name, network.task, file_sha256(path), network)
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
        how = {"runtime": self.runtime, "prompt": self.prompt}
        full, registry = self.full_precision, self.registry
        segmenter = open_segmenter(name, **how, full_precision=full, registry=registry)
        model = registry.segmenter(name)
        self._note(model.name, model.task, registry.hashes(model.name), segmenter)
        return segmenter

    def _note(self, name: str, task: str, sha256: Any, network: Any) -> None:
        entry = {"name": name, "task": task, "sha256": sha256, "runtime": network.runtime}
        self.models.append(entry)
