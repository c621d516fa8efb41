"""Sources of a capture's instances: the data set, a file, or networks."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from cucumbervision.arrays import Array32, Pixels
from cucumbervision.capture.frames import Capture
from cucumbervision.errors import CucumberVisionError, InstancesError
from cucumbervision.fruit.instance import (
    MASK_FAILURES,
    Instance,
    MaskSource,
    in_picture,
    with_keypoints,
)
from cucumbervision.fruit.masks import box_of_mask, is_box_mask, without_flower
from cucumbervision.methods.m6 import fits_well, measure_m6
from cucumbervision.methods.result import Measurement, Selector
from cucumbervision.networks.find import NetworkLoader, PictureLooks
from cucumbervision.networks.keypoint_axis import place_keypoints
from cucumbervision.networks.registry import Registry, load_registry
from cucumbervision.networks.yolo import YoloDetector
from cucumbervision.plugins import Detector, Kind, Plugin, plugins
from cucumbervision.run.options import INSTANCE_SOURCES, MeasureOptions, PlugIns

_MAY_HOLD_FLOWERS = (MaskSource.SAM, MaskSource.SEGMENTER)


@dataclass(frozen=True, eq=False)
class Detections:
    """The fruit detected in one capture.

    Parameters
    ----------
    instances : tuple of Instance
        The instances, with the mask to measure if there is one.
    refused : tuple of CucumberVisionError
        Errors of entries of a file that are no valid instances of this image.
    labels : tuple of str
        The classes that a detector knows.
    posed : bool
        Whether a network looked for keypoints.
    tubes : tuple of Measurement or None
        M6 of each instance whose mask was measured to evaluate the mask; empty if none was.
    left_out : mapping of str to int
        Number of excluded detections by class.
    """

    instances: tuple[Instance, ...]
    refused: tuple[CucumberVisionError, ...] = ()
    labels: tuple[str, ...] = ()
    posed: bool = False
    tubes: tuple[Measurement | None, ...] = ()
    left_out: Mapping[str, int] = field(default_factory=dict)

    def of_classes(self, classes: Collection[str]) -> Detections:
        """Return the detections of some classes; all if `classes` is empty."""
        if not classes:
            return self
        chosen = [k for k, instance in enumerate(self.instances) if _class_of(instance) in classes]
        excluded = [instance for instance in self.instances if _class_of(instance) not in classes]
        return replace(
            self,
            instances=tuple(self.instances[k] for k in chosen),
            left_out=Counter(instance.class_name for instance in excluded),
        )


def _class_of(instance: Instance) -> str:
    return instance.class_name.strip().casefold()


Find: TypeAlias = Callable[["Capture"], Detections]


class Finder:
    """Finds the fruit of captures as the options select; each network is loaded once.

    SAM, and with 'auto' also the networks of the package, are loaded when the first capture needs
    them.

    Parameters
    ----------
    options : MeasureOptions
        Options of the run.
    registry : Registry, optional
        Registry of named networks; by default that of the package.
    plug_ins : PlugIns, optional
        Detector and segmenter of the calling program, in place of those of the options.

    Attributes
    ----------
    networks : NetworkLoader
        Loads the networks, and lists those that are loaded.

    Raises
    ------
    ModelError
        If a network is missing or cannot be loaded.
    InstancesError
        If the file of instances cannot be read.
    PluginError
        If a detector or segmenter of another package cannot be loaded.
    """

    def __init__(
        self,
        options: MeasureOptions,
        registry: Registry | None = None,
        plug_ins: PlugIns | None = None,
    ) -> None:
        plug_ins = plug_ins or PlugIns()
        self._options = options
        detector = _plugged("detectors", options.instances, plug_ins.detector)
        self._painter = _plugged("segmenters", options.segmenter, plug_ins.segmenter)
        self.networks = NetworkLoader(
            registry or load_registry(),
            runtime=options.runtime,
            confidence=options.confidence,
            prompt=options.prompt,
            full_precision=options.full_precision,
            input_sizes=options.input_sizes,
        )
        if self._painter is None and options.segmenter not in (None, "none"):
            self.networks.verify(self.networks.registry.segmenter(options.segmenter).name)
        self._boxes = self._box_finder() if detector is None else _finder_of(*detector)
        parts = (plugin for plugin, _ in filter(None, (detector, self._painter)))
        # Fruit that a program gives are of no plug-in.
        self._plugins = tuple(plugin for plugin in parts if not plugin.is_own)

    @property
    def models(self) -> tuple[dict[str, Any], ...]:
        """The loaded networks, and the plug-ins that take the place of networks."""
        return (*self.networks.models, *(plugin.as_json() for plugin in self._plugins))

    def find(self, capture: Capture) -> Detections:
        """Return the fruit of a capture, with the masks to measure."""
        name, painter = self._options.segmenter, self._painter
        detections = self._boxes(capture).of_classes(self._options.classes)
        if name != "none":
            detections = _without_box_masks(detections)
        # The paper's selector measures the masks of SAM.
        if name is None and self._options.selector is Selector.BEST:
            detections = _with_fitting_masks(capture, detections)
        # Existing masks are used unchanged unless the user chose a segmenter.
        draws_all = painter is not None or name is not None
        instances = list(detections.instances)
        drawn = [k for k, instance in enumerate(instances) if draws_all or instance.mask is None]
        if drawn and (painter is not None or name != "none"):
            prompts = [replace(instances[k], mask=None, mask_source=None) for k in drawn]
            if painter is None:
                answers = tuple(self.networks.segmenter(name).segment(capture.color, prompts))
            else:
                answers = _segmented(*painter, capture, prompts)
            for k, answer in zip(drawn, answers, strict=True):
                instances[k] = answer
        return _finished(capture, detections, tuple(instances), self.networks)

    def _box_finder(self) -> Find:
        options, path = self._options, Path(self._options.instances)
        choice = options.instances if options.instances in INSTANCE_SOURCES else "file"
        if choice == "file" and not path.exists():
            choices = ", ".join((*INSTANCE_SOURCES, *plugins("detectors")))
            raise InstancesError("no such file", source=path, remedy=f"give {choices} or a file")
        if choice == "models":
            return self._network_finder(pose=options.pose)
        if choice == "file" and path.suffix.lower() == ".onnx":
            return self._network_finder(path, options.pose)
        pose = None if options.pose is None else self.networks.pose(options.pose)
        find_listed = _file_finder(path) if choice == "file" else _dataset
        networks = cache(partial(self._network_finder, pose=pose))

        def find(capture: Capture) -> Detections:
            if choice == "auto" and not capture.masks:
                return networks()(capture)
            if choice == "dataset" and not capture.masks:
                raise InstancesError(
                    "the data set has no masks for this capture",
                    source=capture.source or capture.name,
                    remedy="put them into mask_visib/, or choose other --instances",
                )
            detections = find_listed(capture)
            if pose is None or not detections.instances:
                return detections
            poses = pose.detect(capture.color)
            instances = with_keypoints(detections.instances, poses, sure=options.confidence)
            return replace(detections, instances=instances, posed=True)

        return find

    def _network_finder(
        self, file: Path | None = None, pose: YoloDetector | Path | None = None
    ) -> Find:
        # The paper's M4 has the keypoints of a pose network.
        looks, quick = self._options.selector is Selector.BEST, self._options.quick
        detectors = self.networks.detectors(file, pose, quick=quick, looks=looks)
        labels, posed = detectors.labels, detectors.gives_keypoints

        def find_turned(capture: Capture, quarters: int) -> tuple[Instance, ...]:
            color, depth_m, focal_px = _seen(capture)
            color = np.ascontiguousarray(np.rot90(color, quarters))
            depth_m = None if depth_m is None else np.ascontiguousarray(np.rot90(depth_m, quarters))
            found = detectors.find(color, depth_m, focal_px)
            return tuple(fruit.turned(-quarters, color.shape[:2]) for fruit in found)

        def find(capture: Capture) -> Detections:
            found = find_turned(capture, upright_quarters(capture.gravity))
            # A camera mounted on its side: photos without depth are turned by those who took them.
            unknown = capture.gravity is None and capture.depth_m.any() and not quick
            if unknown and _best(found) < _CLEAR:
                others = (find_turned(capture, quarters) for quarters in (1, 3))
                clear = [other for other in others if _best(other) >= _CLEAR]
                found = max([found, *clear], key=lambda fruit: sum(x.confidence for x in fruit))
            return Detections(found, labels=labels, posed=posed)

        return find


def _plugged(kind: Kind, name: str | None, part: Any) -> tuple[Plugin, Any] | None:
    """Return a detector or segmenter of the program or of another package, with its line."""
    if part is not None:
        return Plugin.of(kind, part), part
    if name in plugins(kind):
        return plugins(kind)[str(name)], plugins(kind)[str(name)].load()
    return None


def _segmented(
    plugin: Plugin, segmenter: Any, capture: Capture, prompts: Sequence[Instance]
) -> tuple[Instance, ...]:
    """Return the instances with the masks of a segmenter of another package.

    Raises
    ------
    PluginError
        If it fails, or its answer is no mask of the image for each instance.
    """
    answers = plugin.call(lambda: tuple(segmenter.segment(capture.color, tuple(prompts))))
    if len(answers) != len(prompts):
        raise plugin.error(f"returned {len(answers)} masks for {len(prompts)} fruit")
    words = [answer.mask_failure for answer in answers]
    faults = [fault if fault in MASK_FAILURES else MASK_FAILURES[0] for fault in words]
    return tuple(
        replace(prompt, mask=answer.mask, mask_source=MaskSource.SEGMENTER, mask_failure="")
        if answer.mask is not None and answer.mask.any()
        else replace(prompt, mask_failure=fault)
        for prompt, answer, fault in zip(prompts, answers, faults, strict=True)
    )


def _without_box_masks(detections: Detections) -> Detections:
    """Return fruit whose mask is a filled box without that mask, for the segmenter."""
    instances = tuple(
        replace(instance, mask=None, mask_source=None)
        if instance.mask is not None and is_box_mask(instance.mask)
        else instance
        for instance in detections.instances
    )
    return replace(detections, instances=instances)


def _with_fitting_masks(capture: Capture, detections: Detections) -> Detections:
    """Return fruit with the mask of the detector if a tube fits it well, and that tube."""
    instances: list[Instance] = []
    tubes: list[Measurement | None] = []
    for instance in detections.instances:
        mask, tube = instance.detector_mask, None
        if instance.mask is None and mask is not None and mask.any():
            measured = measure_m6(capture.depth_m, mask, capture.intrinsics)
            if fits_well(measured):
                instance = replace(instance, mask=mask, mask_source=MaskSource.DETECTOR)
                tube = measured
        instances.append(instance)
        tubes.append(tube)
    return replace(detections, instances=tuple(instances), tubes=tuple(tubes))


def _finished(
    capture: Capture,
    detections: Detections,
    instances: tuple[Instance, ...],
    networks: NetworkLoader,
) -> Detections:
    """Return detections with final masks and keypoints, ordered where a pose network did not."""
    cleaned = tuple(
        replace(instance, mask=without_flower(instance.mask, capture.color, instance.detector_mask))
        if instance.mask is not None and instance.mask_source in _MAY_HOLD_FLOWERS
        else instance
        for instance in instances
    )
    placed = place_keypoints(cleaned)
    stem_looker = networks.stem_looker()
    if stem_looker is not None:
        placed = PictureLooks(stem_looker, *_seen(capture)).order(placed)
    pairs = zip(detections.tubes, detections.instances, cleaned, strict=False)
    return replace(
        detections,
        instances=placed,
        tubes=tuple(tube if new.mask is old.mask else None for tube, old, new in pairs),
    )


def dataset_instances(capture: Capture) -> tuple[Instance, ...]:
    """Return a data set's own masks as instances.

    Empty masks are omitted.

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


def _finder_of(plugin: Plugin, detector: Detector) -> Find:
    """Return the finder that calls a detector of the program or of another package."""

    def find(capture: Capture) -> Detections:
        instances: list[Instance] = []
        refused: list[CucumberVisionError] = []
        answers = plugin.call(lambda: tuple(detector(capture)))
        for number, instance in enumerate(answers, 1):
            try:
                inside = plugin.call(partial(in_picture, instance, capture.width, capture.height))
                instances.append(inside)
            except InstancesError as error:
                refused.append(error.at(f"{capture.source or capture.name}, instance {number}"))
        return Detections(tuple(instances), tuple(refused))

    return find


_CLEAR = 0.45
"""Confidence of a clear fruit, without which an image whose up is unknown is turned."""


def _best(fruit: Sequence[Instance]) -> float:
    return max((instance.confidence for instance in fruit), default=0.0)


def upright_quarters(gravity: tuple[float, float, float] | None) -> int:
    """Return the counterclockwise quarter turns after which up is up in an image.

    The networks learnt mostly from hanging fruit. 0 where gravity is unknown, or the camera looks
    steeply up or down.

    Examples
    --------
    >>> [upright_quarters(down) for down in (None, (0, 1, 0), (-1, 0.2, 0.3), (1, 0, 0), (1, 0, 2))]
    [0, 0, 1, 3, 0]
    """
    across, down, away = gravity or (0.0, 1.0, 0.0)
    if abs(away) > np.hypot(across, down):
        return 0
    return int(round(-np.arctan2(across, down) / (np.pi / 2)) % 4)


def _seen(capture: Capture) -> tuple[Pixels, Array32 | None, float | None]:
    """Return colour, depth and focal length in pixels, both None for an image without depth."""
    if not capture.depth_m.any():
        return capture.color, None, None
    return capture.color, capture.depth_m, capture.intrinsics.fx_px


def _file_finder(path: Path) -> Find:
    from cucumbervision.fruit.label_files import read_instances

    file = read_instances(path)

    def find(capture: Capture) -> Detections:
        names = (capture.name, capture.source)
        return Detections(
            *file.for_capture(names, capture.width, capture.height, frame=capture.frame)
        )

    return find


def _dataset(capture: Capture) -> Detections:
    return Detections(dataset_instances(capture))
