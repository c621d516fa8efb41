"""The networks of a run: loaded when first needed, verified once, named in the provenance."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

from cucumbervision.errors import ModelError

if TYPE_CHECKING:
    from pathlib import Path

    import numpy as np
    from numpy.typing import NDArray

    from cucumbervision.perception.ends import EndTeller
    from cucumbervision.perception.instances import Instance
    from cucumbervision.perception.registry import Registry
    from cucumbervision.perception.sam import Segmenter
    from cucumbervision.perception.yolo import YoloDetector

__all__ = ["Detectors", "NetworkOptions", "Segmenters", "load_ends", "load_pose"]


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
        from cucumbervision.perception.merge import each_once, merge_instances

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
