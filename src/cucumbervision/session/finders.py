"""Where the fruit of a capture come from: the data set, a file, or the networks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from cucumbervision.errors import CucumberVisionError, InstancesError, ModelError
from cucumbervision.perception.instances import Instance, MaskSource, box_of_mask

if TYPE_CHECKING:
    from cucumbervision.capture.frames import Capture
    from cucumbervision.perception.sam import Segmenter
    from cucumbervision.session.options import MeasureOptions

__all__ = ["Finder", "Found", "dataset_instances", "make_finder"]

_NO_DETECTOR = ModelError(
    "this version comes without a cucumber detector",
    source="--instances models",
    remedy="name a YOLO ONNX export, COCO JSON or YOLO txt boxes with --instances FILE",
)


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


def make_finder(options: MeasureOptions) -> Finder:
    """Load what a run needs to find fruit.

    Parameters
    ----------
    options : MeasureOptions
        The run's choices.

    Returns
    -------
    Finder
        Networks are loaded once, SAM only when the first capture needs it.

    Raises
    ------
    ModelError
        If a network is missing or cannot be loaded.
    InstancesError
        If the file of instances cannot be read.
    """
    models: list[dict[str, Any]] = []
    boxes = _box_finder(options, models)
    segmenter = _LazySegmenter(options, models)
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


def _box_finder(options: MeasureOptions, models: list[dict[str, Any]]) -> Find:
    choice = options.instances
    if choice == "models":
        raise _NO_DETECTOR
    if choice == "dataset":
        return _dataset_or_error
    if choice == "auto":
        return _dataset_or_models
    path = Path(choice)
    if not path.exists():
        raise InstancesError(
            "no such file", source=path, remedy="give auto, models, dataset or a file"
        )
    if path.suffix.lower() == ".onnx":
        return _network_finder(path, options, models)
    return _file_finder(path)


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


def _dataset_or_models(capture: Capture) -> Found:
    if not capture.masks:
        raise _NO_DETECTOR
    return Found(dataset_instances(capture))


def _network_finder(path: Path, options: MeasureOptions, models: list[dict[str, Any]]) -> Find:
    from cucumbervision.perception.registry import file_sha256
    from cucumbervision.perception.yolo import YoloDetector, with_keypoints

    def load(file: Path) -> YoloDetector:
        detector = YoloDetector(
            file, options.runtime, options.confidence, full_precision=options.full_precision
        )
        models.append({"name": file.name, "sha256": file_sha256(file), "runtime": detector.runtime})
        return detector

    detector = load(path)
    pose = load(options.pose) if options.pose else None

    def find(capture: Capture) -> Found:
        found = detector.detect(capture.color)
        if pose is not None and found:
            found = with_keypoints(found, pose.detect(capture.color))
        return Found(found)

    return find


class _LazySegmenter:
    """SAM, loaded when first asked for: captures with masks of their own never need it."""

    def __init__(self, options: MeasureOptions, models: list[dict[str, Any]]) -> None:
        self._options, self._models = options, models
        self._files: dict[str, dict[str, Path]] = {}
        self._loaded: dict[str, Segmenter] = {}

    def check(self, name: str) -> None:
        """Raise a ModelError before any capture is read, if the model is not here and whole."""
        self._verified(name)

    def get(self, name: str) -> Segmenter:
        if name not in self._loaded:
            from cucumbervision.perception.registry import load_registry
            from cucumbervision.perception.sam import Segmenter

            files = self._verified(name)
            segmenter = Segmenter(
                (files["encoder"], files["decoder"]),
                self._options.runtime,
                self._options.prompt,
                full_precision=self._options.full_precision,
            )
            known = load_registry().hashes(name)
            hashes = {role: known[file.name] for role, file in files.items()}
            self._models.append({"name": name, "sha256": hashes, "runtime": segmenter.runtime})
            self._loaded[name] = segmenter
        return self._loaded[name]

    def _verified(self, name: str) -> dict[str, Path]:
        # The registry reads every byte to verify a model: once a run is enough.
        if name not in self._files:
            from cucumbervision.perception.registry import load_registry

            self._files[name] = load_registry().resolve(name)
        return self._files[name]
