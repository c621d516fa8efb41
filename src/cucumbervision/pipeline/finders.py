"""Where the fruit of a capture come from: the data set, a file, or the networks of a run."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias

from cucumbervision.errors import CucumberVisionError, InstancesError, ModelError
from cucumbervision.perception.instances import Instance, MaskSource
from cucumbervision.perception.masks import box_of_mask

if TYPE_CHECKING:
    from pathlib import Path

    import numpy as np
    from numpy.typing import NDArray

    from cucumbervision.capture.frames import Capture
    from cucumbervision.perception.ends import EndTeller
    from cucumbervision.perception.instances import Instance
    from cucumbervision.perception.registry import Registry
    from cucumbervision.perception.sam import Segmenter
    from cucumbervision.perception.yolo import YoloDetector
    from cucumbervision.pipeline.options import MeasureOptions

__all__ = [
    "Detectors",
    "Finder",
    "Found",
    "NetworkOptions",
    "Segmenters",
    "dataset_instances",
    "demo_options",
    "load_ends",
    "load_pose",
    "make_finder",
]


@dataclass(frozen=True, eq=False)
class Found:
    """The fruit of one capture.

    Parameters
    ----------
    instances : tuple of Instance
        Each with the mask to measure, where one could be had.
    clipped : frozenset of int
        Which of them reached beyond the picture and were cut to it.
    refused : tuple of CucumberVisionError
        What a file gave that is no fruit in this picture.
    """

    instances: tuple[Instance, ...]
    clipped: frozenset[int] = frozenset()
    refused: tuple[CucumberVisionError, ...] = ()


Find: TypeAlias = Callable[["Capture"], Found]


@dataclass(frozen=True)
class Finder:
    """What finds the fruit, and which networks take part.

    Parameters
    ----------
    find : callable
        Gives the fruit of a capture.
    models : list of dict
        Name, SHA-256 and runtime of each network, for the provenance.
    """

    find: Find
    models: list[dict[str, Any]]


def make_finder(options: MeasureOptions, registry: Registry | None = None) -> Finder:
    """Load what a run needs to find fruit.

    Parameters
    ----------
    options : MeasureOptions
        The run's choices.
    registry : Registry, optional
        Where networks with a name lie; the package's own if not given.

    Returns
    -------
    Finder
        Networks are loaded once; SAM, and the package's own networks where 'auto' was chosen,
        only when the first capture needs them.

    Raises
    ------
    ModelError
        If a network is missing or cannot be loaded.
    InstancesError
        If the file of instances cannot be read.
    """
    if registry is None:
        from cucumbervision.perception.registry import load_registry

        registry = load_registry()
    models: list[dict[str, Any]] = []
    boxes = _box_finder(options, registry, models)
    segmenter = Segmenters(registry, options, models)
    if options.segmenter not in (None, "none"):
        segmenter.check(options.segmenter)

    def find(capture: Capture) -> Found:
        found = boxes(capture)
        name = options.segmenter or "mobile-sam"
        # Masks that were given are used as they are unless a segmenter was asked for.
        drawn = [k for k, i in enumerate(found.instances) if options.segmenter or i.mask is None]
        if name == "none" or not drawn:
            return found
        prompts = [replace(found.instances[k], mask=None, mask_source=None) for k in drawn]
        masked = dict(zip(drawn, segmenter.get(name).segment(capture.color, prompts), strict=True))
        instances = tuple(masked.get(k, one) for k, one in enumerate(found.instances))
        return replace(found, instances=instances)

    return Finder(find, models)


def dataset_instances(capture: Capture) -> tuple[Instance, ...]:
    """Give a data set's own masks as instances.

    An empty mask is left out: there is no fruit to measure.

    Examples
    --------
    >>> import numpy as np
    >>> from cucumbervision.capture.frames import Capture
    >>> from cucumbervision.capture.intrinsics import Intrinsics
    >>> mask = np.zeros((48, 64), bool)
    >>> mask[10:20, 5:9] = True
    >>> capture = Capture(
    ...     np.zeros((48, 64, 3), np.uint8),
    ...     np.zeros((48, 64), np.float32),
    ...     Intrinsics(64, 48, 60.0, 60.0, 32.0, 24.0),
    ...     name="a",
    ...     masks=(mask,),
    ... )
    >>> dataset_instances(capture)[0].box.tolist()
    [4.5, 9.5, 8.5, 19.5]
    """
    return tuple(
        Instance(box_of_mask(mask), mask=mask, mask_source=MaskSource.DATASET)
        for mask in capture.masks
        if mask.any()
    )


def demo_options(registry: Registry) -> tuple[MeasureOptions, str]:
    """Choose how the bundled captures are measured, and say in a line who finds the fruit.

    Parameters
    ----------
    registry : Registry
        With a detector of its own, that one finds them; else their masks' boxes are given.

    Returns
    -------
    options : MeasureOptions
    line : str
        For people.

    Examples
    --------
    >>> from cucumbervision.perception.registry import load_registry
    >>> options, line = demo_options(load_registry())
    >>> line.endswith("masks by mobile-sam.")
    True
    """
    from cucumbervision.pipeline.options import MeasureOptions

    detector, pose = registry.default("segment"), registry.default("pose")
    if detector is None:
        options = MeasureOptions(instances="dataset", segmenter="mobile-sam")
        return options, "Fruit by the boxes of the captures' own masks, masks by mobile-sam."
    keypoints = f", keypoints by {pose.name}" if pose else ""
    options = MeasureOptions(instances="models", segmenter="mobile-sam")
    return options, f"Fruit by {detector.name}{keypoints}, masks by mobile-sam."


def _box_finder(options: MeasureOptions, registry: Registry, models: list[dict[str, Any]]) -> Find:
    choice, path = options.instances, Path(options.instances)
    if choice == "models":
        return _network_finder(Detectors.from_registry(registry, options, models))
    if choice not in ("auto", "dataset") and not path.exists():
        raise InstancesError(
            "no such file", source=path, remedy="give auto, models, dataset or a file"
        )
    if choice not in ("auto", "dataset") and path.suffix.lower() == ".onnx":
        return _network_finder(Detectors.from_file(path, options, models))
    if choice == "auto":
        return _auto_finder(options, registry, models)
    given = _dataset_or_error if choice == "dataset" else _file_finder(path)
    return _with_pose(given, load_pose(options, models))


def _auto_finder(options: MeasureOptions, registry: Registry, models: list[dict[str, Any]]) -> Find:
    """Take a data set's masks where there are some, and load the networks where there are none."""
    pose = load_pose(options, models)
    given = _with_pose(lambda capture: Found(dataset_instances(capture)), pose)
    loaded: list[Find] = []

    def find(capture: Capture) -> Found:
        if capture.masks:
            return given(capture)
        if not loaded:
            loaded.append(_network_finder(Detectors.from_registry(registry, options, models, pose)))
        return loaded[0](capture)

    return find


def _network_finder(detectors: Detectors) -> Find:
    return lambda capture: Found(detectors.find(capture.color))


def _with_pose(find: Find, pose: YoloDetector | None) -> Find:
    """Give a pose network's keypoints to fruit that come from elsewhere."""
    if pose is None:
        return find

    def find_with_keypoints(capture: Capture) -> Found:
        from cucumbervision.perception.instances import with_keypoints

        found = find(capture)
        if not found.instances:
            return found
        poses = pose.detect(capture.color)
        return replace(found, instances=with_keypoints(found.instances, poses))

    return find_with_keypoints


def _file_finder(path: Path) -> Find:
    from cucumbervision.perception.instance_files import read_instances

    file = read_instances(path)

    def find(capture: Capture) -> Found:
        names = (capture.name, capture.source)
        given = file.for_capture(names, capture.width, capture.height, frame=capture.frame)
        cut = frozenset(k for k, clipped in enumerate(given.clipped) if clipped)
        return Found(given.instances, cut, given.refused)

    return find


def _dataset_or_error(capture: Capture) -> Found:
    if not capture.masks:
        raise InstancesError(
            "the data set has no masks for this capture",
            source=capture.source or capture.name,
            remedy="put them into mask_visib/, or choose other --instances",
        )
    return Found(dataset_instances(capture))


class NetworkOptions(Protocol):
    """What a run says about its networks; `MeasureOptions` and `DetectOptions` do."""

    @property
    def runtime(self) -> str:
        """What runs them."""

    @property
    def confidence(self) -> float:
        """Detections below it are left out."""

    @property
    def prompt(self) -> str:
        """What SAM is shown."""

    @property
    def full_precision(self) -> bool:
        """Compute in float32."""

    @property
    def pose(self) -> Path | None:
        """A pose network of the user's own."""


class Detectors:
    """A detector, a pose network beside it, and what puts their finds together.

    Parameters
    ----------
    detector : YoloDetector
        Whose detections are the fruit; of whatever class, since a fruit of two classes is one.
    pose : YoloDetector, optional
        Whose keypoints they get.
    """

    def __init__(self, detector: YoloDetector, pose: YoloDetector | None = None) -> None:
        self._detector, self._pose = detector, pose

    @classmethod
    def from_file(
        cls, path: Path, options: NetworkOptions, models: list[dict[str, Any]]
    ) -> Detectors:
        """Load a user's own export, and the pose network that the options name.

        Raises
        ------
        ModelError
            If a file is missing or no network of a known kind.
        """
        return cls(_load(path, options, models), load_pose(options, models))

    @classmethod
    def from_registry(
        cls,
        registry: Registry,
        options: NetworkOptions,
        models: list[dict[str, Any]],
        pose: YoloDetector | None = None,
    ) -> Detectors:
        """Load the package's own networks.

        A pose network that is given, or that the options name, stands in for the package's own.

        Raises
        ------
        ModelError
            If the package has no detector.
        ModelHashError
            If a file is damaged.
        """
        segment, own_pose = registry.default("segment"), registry.default("pose")
        if segment is None:
            raise ModelError(
                "this version comes without a cucumber detector",
                source="--instances models",
                remedy="name a YOLO ONNX export, COCO JSON or YOLO txt boxes with --instances FILE",
            )
        detector = _load_named(registry, segment.name, options, models)
        pose = pose or load_pose(options, models)
        if pose is None and own_pose is not None:
            pose = _load_named(registry, own_pose.name, options, models)
        return cls(detector, pose)

    @property
    def labels(self) -> tuple[str, ...]:
        """The detector's class names, in its order; empty where it names none."""
        return tuple(name for _, name in sorted(self._detector.names.items()))

    @property
    def gives_keypoints(self) -> bool:
        """Whether fruit may come with keypoints."""
        return self._pose is not None or self._detector.task == "pose"

    def find(self, color_rgb: NDArray[np.uint8]) -> tuple[Instance, ...]:
        """Find the fruit of one picture, each once.

        Parameters
        ----------
        color_rgb : ndarray of uint8, shape (H, W, 3)
            The picture.

        Returns
        -------
        tuple of Instance
            Best first, with the detector's masks and the pose network's keypoints.
        """
        from cucumbervision.perception.instances import each_once, merge_instances

        found = merge_instances(self._detector.detect(color_rgb))
        if self._pose is None or not found:
            return found
        return each_once(found, self._pose.detect(color_rgb))


def load_pose(options: NetworkOptions, models: list[dict[str, Any]]) -> YoloDetector | None:
    """Load the pose network that the options name, if they name one.

    Raises
    ------
    ModelError
        If the file is missing, or no YOLO pose network.
    """
    if options.pose is None:
        return None
    pose = _load(options.pose, options, models)
    if pose.task != "pose":
        raise ModelError(
            f"it is a {pose.task} network and gives no keypoints",
            source=options.pose,
            remedy="name a YOLO pose ONNX export with --pose",
        )
    return pose


class Segmenters:
    """SAM, loaded when first asked for: captures with masks of their own never need it.

    Parameters
    ----------
    registry : Registry
        Where the networks lie.
    options : NetworkOptions
        Runtime, prompt and precision.
    models : list of dict
        Gets name, SHA-256 and runtime of each network that is loaded.
    """

    def __init__(
        self, registry: Registry, options: NetworkOptions, models: list[dict[str, Any]]
    ) -> None:
        self._registry, self._options, self._models = registry, options, models
        self._files: dict[str, dict[str, Path]] = {}
        self._loaded: dict[str, Segmenter] = {}

    def check(self, name: str) -> None:
        """Raise a ModelError before any picture is read, if the model is not here and whole."""
        self._verified(name)

    def get(self, name: str) -> Segmenter:
        """Give a segmenter by the registry's name, loaded once."""
        if name not in self._loaded:
            from cucumbervision.perception.sam import Segmenter

            files = self._verified(name)
            segmenter = Segmenter(
                (files["encoder"], files["decoder"]),
                self._options.runtime,
                self._options.prompt,
                full_precision=self._options.full_precision,
            )
            known = self._registry.hashes(name)
            hashes = {role: known[file.name] for role, file in files.items()}
            self._models.append({"name": name, "sha256": hashes, "runtime": segmenter.runtime})
            self._loaded[name] = segmenter
        return self._loaded[name]

    def _verified(self, name: str) -> dict[str, Path]:
        # The registry reads every byte to verify a model: once a run is enough.
        if name not in self._files:
            self._files[name] = self._registry.resolve(name)
        return self._files[name]


def _load_named(
    registry: Registry, name: str, options: NetworkOptions, models: list[dict[str, Any]]
) -> YoloDetector:
    path = registry.resolve(name)["network"]
    return _load(path, options, models, (name, registry.hashes(name)[path.name]))


def _load(
    path: Path,
    options: NetworkOptions,
    models: list[dict[str, Any]],
    known: tuple[str, str] | None = None,
) -> YoloDetector:
    from cucumbervision.perception.registry import file_sha256
    from cucumbervision.perception.yolo import YoloDetector

    network = YoloDetector(
        path, options.runtime, options.confidence, full_precision=options.full_precision
    )
    name, sha256 = known or (path.name, file_sha256(path))
    models.append({"name": name, "sha256": sha256, "runtime": network.runtime})
    if network.by_place:
        network.ends = load_ends(models)
    return network


def load_ends(models: list[dict[str, Any]]) -> EndTeller | None:
    """Load the package's network that tells a fruit's ends apart, if it has one.

    Parameters
    ----------
    models : list of dict
        Gets its name, SHA-256 and runtime.
    """
    from cucumbervision.perception.ends import EndTeller
    from cucumbervision.perception.registry import load_registry

    registry = load_registry()
    own = registry.default("ends")
    if own is None:
        return None
    path = registry.resolve(own.name)["network"]
    ends = EndTeller(path)
    sha256 = registry.hashes(own.name)[path.name]
    models.append({"name": own.name, "sha256": sha256, "runtime": ends.runtime})
    return ends
