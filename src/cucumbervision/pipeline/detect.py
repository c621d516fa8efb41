"""Find cucumbers in plain pictures: no depth, no lengths."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from cucumbervision._version import __version__
from cucumbervision.about import LICENCE, source_offer
from cucumbervision.capture.files import json_value, read_photo, write_bytes, write_jpeg
from cucumbervision.capture.source import safe_name, unique_name
from cucumbervision.errors import CucumberVisionError, ModelError
from cucumbervision.pipeline.coco_results import coco_categories, coco_results, results_text
from cucumbervision.pipeline.exports import FAILURE_COLUMNS, CsvSink, write_json
from cucumbervision.pipeline.networks import Detectors, Segmenters
from cucumbervision.pipeline.pictures import find_pictures
from cucumbervision.pipeline.results import Failure

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np
    from numpy.typing import NDArray

    from cucumbervision.perception.instances import Instance
    from cucumbervision.perception.registry import Registry
    from cucumbervision.pipeline.pictures import Picture, PictureList

__all__ = ["DetectOptions", "DetectResult", "Looked", "detect_inputs"]

_JPEG_QUALITY = 90


@dataclass(frozen=True)
class DetectOptions:
    """One run's choices.

    Parameters
    ----------
    model : Path, optional
        A YOLO ONNX export of the user's own; the package's detector if not given.
    pose : Path, optional
        A YOLO pose ONNX export of the user's own; with the package's detector, the package's pose
        network if not given.
    segmenter : str
        Who draws the masks: 'mobile-sam', 'sam-vit-b', or 'none' for the detector's.
    prompt : str
        SAM's prompt: 'box+point', 'box' or 'point'.
    confidence : float
        Detections below it are left out.
    runtime : str
        What runs the networks.
    full_precision : bool
        Networks in float32: the same finds on every machine.
    overlays : bool
        Whether annotated pictures are written.
    """

    model: Path | None = None
    pose: Path | None = None
    segmenter: str = "mobile-sam"
    prompt: str = "box+point"
    confidence: float = 0.30
    runtime: str = "auto"
    full_precision: bool = True
    overlays: bool = True


@dataclass(frozen=True)
class Looked:
    """One picture that was looked at: its name, its fruit's scores, and the time that it took."""

    name: str
    scores: tuple[float, ...]
    seconds: float


@dataclass(frozen=True, eq=False)
class DetectResult:
    """What one run gave.

    Parameters
    ----------
    looked : list of Looked
        The pictures, in order.
    failures : list of Failure
        What could not be read; the rest was looked at.
    skipped : int
        Files in folders that are no pictures.
    models : list of dict
        Name, SHA-256 and runtime of each network.
    out : Path
        Where the files are.
    """

    looked: list[Looked] = field(default_factory=list)
    failures: list[Failure] = field(default_factory=list)
    skipped: int = 0
    models: list[dict[str, Any]] = field(default_factory=list)
    out: Path = Path()


Report: TypeAlias = Callable[[int, int], None]


def detect_inputs(
    inputs: Sequence[str | Path],
    out: Path,
    options: DetectOptions,
    report: Report | None = None,
    registry: Registry | None = None,
) -> DetectResult:
    """Find the fruit of every picture, and write what was found into a folder.

    `out` gets `results.json` (COCO results), `images.json` (the pictures, classes and provenance
    as a COCO data set without annotations), `failures.csv`, and `overlays/` with one annotated
    JPEG a picture. A picture that cannot be read is noted and the others go on; a run that is
    interrupted leaves what it found.

    Parameters
    ----------
    inputs : sequence of str or Path
        Files, folders and patterns.
    out : Path
        Made where it is missing; pictures in it are not looked at.
    options : DetectOptions
        The run's choices.
    report : callable, optional
        Called with the number of pictures done and their total; for progress bars.
    registry : Registry, optional
        Where networks with a name lie; the package's own if not given.

    Returns
    -------
    DetectResult

    Raises
    ------
    CucumberVisionError
        If the run cannot start: no picture anywhere, a network that cannot be loaded, or a folder
        that cannot be written.
    """
    listed = find_pictures(inputs, leave_out=out)
    if not listed.pictures and not listed.failures:
        raise CucumberVisionError(
            "there are no pictures",
            source=", ".join(map(str, inputs)),
            remedy="name JPEG, PNG, WebP, TIFF or BMP files, or a folder with some",
        )
    result = DetectResult(skipped=listed.skipped, out=out)
    eye = _Eye(options, registry, result.models)
    folder = _Folder(out, eye, options)
    with folder.failures as failures:
        for failure in listed.failures:
            _note(failure, result, failures)
        try:
            _look_at_all(listed, eye, folder, result, report)
        finally:
            folder.finish(result)
    return result


class _Eye:
    """Detector, pose network and SAM as one."""

    def __init__(
        self, options: DetectOptions, registry: Registry | None, models: list[dict[str, Any]]
    ) -> None:
        from cucumbervision.perception.registry import load_registry

        registry = registry or load_registry()
        if options.model is not None:
            self._detectors = Detectors.from_file(options.model, options, models)
        elif registry.default("segment") is None:
            raise ModelError(
                "this version comes without a cucumber detector",
                remedy="name a YOLO ONNX export with --model FILE",
            )
        else:
            self._detectors = Detectors.from_registry(registry, options, models)
        self._segmenter = options.segmenter
        self._segmenters = Segmenters(registry, options, models)
        if options.segmenter != "none":
            self._segmenters.check(options.segmenter)

    @property
    def labels(self) -> tuple[str, ...]:
        return self._detectors.labels

    @property
    def gives_keypoints(self) -> bool:
        return self._detectors.gives_keypoints

    def look(self, color_rgb: NDArray[np.uint8]) -> tuple[Instance, ...]:
        found = self._detectors.find(color_rgb)
        if not found or self._segmenter == "none":
            return found
        return self._segmenters.get(self._segmenter).segment(color_rgb, found)


class _Folder:
    """The output folder while it fills."""

    def __init__(self, out: Path, eye: _Eye, options: DetectOptions) -> None:
        self._out, self._eye, self._options = out, eye, options
        self._started = datetime.now(UTC)
        self._labels = list(eye.labels)
        self._images: list[dict[str, Any]] = []
        self._entries: list[dict[str, Any]] = []
        self._taken: set[str] = set()
        try:
            (out / "overlays" if options.overlays else out).mkdir(parents=True, exist_ok=True)
            self.failures = CsvSink(out / "failures.csv", FAILURE_COLUMNS)
        except OSError as error:
            raise CucumberVisionError(
                f"cannot be written ({error.strerror})", source=out, remedy="choose another --out"
            ) from error

    def add(
        self, picture: Picture, color_rgb: NDArray[np.uint8], found: tuple[Instance, ...]
    ) -> None:
        self._labels += sorted({one.class_name for one in found} - set(self._labels))
        numbers = {label: k for k, label in enumerate(self._labels, start=1)}
        height, width = color_rgb.shape[:2]
        number, name = len(self._images) + 1, picture.name
        self._images.append({"id": number, "file_name": name, "width": width, "height": height})
        self._entries += coco_results(
            found, number, name, numbers, keypoints=self._eye.gives_keypoints
        )
        if self._options.overlays:
            stem = unique_name(safe_name(str(Path(name).with_suffix(""))), self._taken)
            _write_overlay(self._out / "overlays" / f"{stem}.jpg", color_rgb, found)

    def finish(self, result: DetectResult) -> None:
        info = {
            "description": "Pictures that cucumbervision detect looked at; results.json has them",
            "software": f"cucumbervision {__version__}",
            "licence": LICENCE,
            "source": source_offer(),
            "started": self._started.isoformat(timespec="seconds"),
            "options": json_value(vars(self._options)),
            "models": result.models,
        }
        pictures = {
            "info": info,
            "licenses": [],
            "images": self._images,
            "annotations": [],
            "categories": coco_categories(self._labels),
        }
        write_json(self._out / "images.json", pictures)
        text = results_text(self._entries)
        write_bytes(self._out / "results.json", text.encode())


def _look_at_all(
    listed: PictureList, eye: _Eye, folder: _Folder, result: DetectResult, report: Report | None
) -> None:
    for done, picture in enumerate(listed.pictures, start=1):
        start = time.perf_counter()
        try:
            color = read_photo(picture.path)
            found = eye.look(color)
            folder.add(picture, color, found)
        except CucumberVisionError as error:
            _note(
                Failure(str(picture.path), picture.name, error.code, str(error)),
                result,
                folder.failures,
            )
        else:
            scores = tuple(one.confidence for one in found)
            result.looked.append(Looked(picture.name, scores, time.perf_counter() - start))
        if report is not None:
            report(done, len(listed.pictures))


def _note(failure: Failure, result: DetectResult, sink: CsvSink) -> None:
    sink.write(vars(failure))
    result.failures.append(failure)


def _write_overlay(path: Path, color_rgb: NDArray[np.uint8], found: tuple[Instance, ...]) -> None:
    from cucumbervision.pipeline.detect_overlay import draw_detections

    write_jpeg(path, draw_detections(color_rgb, found), _JPEG_QUALITY)
