"""Find cucumbers in plain pictures: no depth, no lengths."""

from __future__ import annotations

import glob
import json
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from cucumbervision.about import software
from cucumbervision.capture.files import json_value, write_bytes
from cucumbervision.capture.pictures import PHOTO_SUFFIXES, read_photo, write_jpeg
from cucumbervision.capture.source import safe_name, unique_name
from cucumbervision.errors import CaptureError, CucumberVisionError, wrap_os_errors
from cucumbervision.perception.confidence import DEFAULT_CONFIDENCE
from cucumbervision.perception.instances import KEYPOINT_NAMES, SKELETON
from cucumbervision.perception.keypoint_axis import place_keypoints
from cucumbervision.perception.mask_codes import encode_rle
from cucumbervision.pipeline.measurer import Boundary, Failure, exit_code
from cucumbervision.pipeline.tables import FAILURE_COLUMNS, CsvSink, write_json

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from numpy.typing import NDArray

    from cucumbervision.perception.instances import Instance
    from cucumbervision.perception.registry import Registry


@dataclass(frozen=True)
class InputPicture:
    """A file to look at.

    Parameters
    ----------
    path : Path
        Where it lies.
    name : str
        What tables call it: its path below the folder that was given, with '/'; no two are alike.
    """

    path: Path
    name: str


@dataclass(frozen=True)
class PictureList:
    """What the inputs hold.

    Parameters
    ----------
    pictures : tuple of InputPicture
        Each file once, in the inputs' order, sorted within a folder.
    skipped : int
        Files in folders that are no pictures by their ending.
    failures : tuple of Failure
        Inputs that name nothing.
    """

    pictures: tuple[InputPicture, ...]
    skipped: int
    failures: tuple[Failure, ...]


def find_pictures(inputs: Sequence[str | Path], leave_out: Path | None = None) -> PictureList:
    """List the pictures of files, folders (with those below) and patterns such as 'a/*.jpg'.

    A file that is named is a picture whatever it is called; in folders and patterns the ending
    decides, and hidden files are passed over.

    Parameters
    ----------
    inputs : sequence of str or Path
        What the user named.
    leave_out : Path, optional
        A folder whose files are not taken: that of the results.

    Examples
    --------
    >>> import tempfile
    >>> folder = Path(tempfile.mkdtemp())
    >>> for name in ("b.JPG", "a.png", "notes.txt"):
    ...     _ = (folder / name).write_bytes(b"")
    >>> found = find_pictures([folder, folder / "b.JPG"])
    >>> [picture.name for picture in found.pictures], found.skipped
    (['a.png', 'b.JPG'], 1)
    """
    apart = leave_out.resolve() if leave_out is not None else None
    seen: set[Path] = set()
    names: set[str] = set()
    pictures: list[InputPicture] = []
    failures: list[Failure] = []
    skipped = 0
    for given in inputs:
        files, failure = _files(str(given))
        failures += [failure] if failure else []
        for path, name, named in files:
            whole = path.resolve()
            if whole in seen or (not named and apart is not None and apart in whole.parents):
                continue
            seen.add(whole)
            if not named and path.suffix.lower() not in PHOTO_SUFFIXES:
                skipped += 1
                continue
            pictures.append(InputPicture(path, _own_name((name, path.as_posix()), whole, names)))
    return PictureList(tuple(pictures), skipped, tuple(failures))


def _files(given: str) -> tuple[Iterable[tuple[Path, str, bool]], Failure | None]:
    """Return each file with its name and whether the user named it, or why there is none."""
    path = Path(given)
    if path.is_dir():
        return _below(path), None
    if path.exists():
        return [(path, path.name, True)], None
    # Some shells leave patterns alone. Path.glob takes no absolute ones.
    matches = [Path(match) for match in sorted(glob.glob(given, recursive=True))]  # noqa: PTH207
    if not matches:
        fault = "no file matches it" if glob.has_magic(given) else "does not exist"
        error = CaptureError(fault, source=given, remedy="check the path")
        return [], Failure(given, "", error.code, str(error))
    return (file for match in matches for file in _matched(match)), None


def _matched(match: Path) -> Iterator[tuple[Path, str, bool]]:
    if match.is_dir():
        yield from _below(match)
    else:
        yield match, match.name, False


def _below(folder: Path) -> Iterator[tuple[Path, str, bool]]:
    for path in sorted(folder.rglob("*")):
        inner = path.relative_to(folder)
        if path.is_file() and not any(part.startswith(".") for part in inner.parts):
            yield path, inner.as_posix(), False


def _own_name(names: tuple[str, ...], whole: Path, taken: set[str]) -> str:
    name = next((name for name in names if name not in taken), whole.as_posix())
    taken.add(name)
    return name


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
    segmenter : str, optional
        Name of the network that draws the masks, or 'none' to keep the detector's.
    prompt : str
        SAM's prompt: 'box+point', 'box' or 'point'.
    confidence : float
        Detections below it are left out.
    input_sizes : tuple of int
        Long sides that the networks see, as in `MeasureOptions`.
    runtime : str
        What runs the networks.
    full_precision : bool
        Networks in float32: the same finds on every machine.
    overlays : bool
        Whether annotated pictures are written.
    """

    model: Path | None = None
    pose: Path | None = None
    segmenter: str | None = None
    prompt: str = "box+point"
    confidence: float = DEFAULT_CONFIDENCE
    input_sizes: tuple[int, ...] = ()
    runtime: str = "auto"
    full_precision: bool = True
    overlays: bool = True


@dataclass(frozen=True)
class DetectedPicture:
    """The result of one picture: its name, its fruit's confidences, and the seconds it took."""

    name: str
    scores: tuple[float, ...]
    seconds: float


@dataclass(frozen=True, eq=False)
class DetectResult:
    """What one run gave.

    Parameters
    ----------
    pictures : list of DetectedPicture
        The pictures, in order.
    failures : list of Failure
        What could not be read; the rest was examined.
    skipped : int
        Files in folders that are no pictures.
    models : list of dict
        Name, SHA-256 and runtime of each network.
    out : Path
        Where the files are.
    """

    pictures: list[DetectedPicture] = field(default_factory=list)
    failures: list[Failure] = field(default_factory=list)
    skipped: int = 0
    models: list[dict[str, Any]] = field(default_factory=list)
    out: Path = Path()

    @property
    def exit_code(self) -> int:
        """What the command's exit code is: 0, 1, 2 or 70, as in `measurer.exit_code`."""
        return exit_code(len(self.pictures), self.failures)


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
        Made where it is missing; pictures in it are left out.
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
    run = _Run(DetectResult(skipped=listed.skipped, out=out), options, registry)
    with run.failures:
        for failure in listed.failures:
            run.note(failure)
        try:
            for done, picture in enumerate(listed.pictures, start=1):
                failed: list[Failure] = []
                with Boundary(failed, str(picture.path), picture.name):
                    run.look_at(picture)
                for failure in failed:
                    run.note(failure)
                if report is not None:
                    report(done, len(listed.pictures))
        finally:
            run.finish()
    return run.result


class _Run:
    """One run: its networks, and the output folder while it fills."""

    def __init__(
        self, result: DetectResult, options: DetectOptions, registry: Registry | None
    ) -> None:
        from cucumbervision.perception.networks import NetworkLoader

        self.result, self._options = result, options
        self._started = datetime.now(UTC)
        self._networks = NetworkLoader(
            registry,
            runtime=options.runtime,
            confidence=options.confidence,
            prompt=options.prompt,
            full_precision=options.full_precision,
            input_sizes=options.input_sizes,
            models=result.models,
        )
        self._detectors = self._networks.detectors(options.model, options.pose)
        self._segmenter = "none"
        if options.segmenter != "none":
            self._segmenter = self._networks.registry.segmenter(options.segmenter).name
            self._networks.verify(self._segmenter)
        self._labels = list(self._detectors.labels)
        self._images: list[dict[str, Any]] = []
        self._entries: list[dict[str, Any]] = []
        self._taken: set[str] = set()
        out = result.out
        with wrap_os_errors("cannot be written", out):
            (out / "overlays" if options.overlays else out).mkdir(parents=True, exist_ok=True)
            self.failures = CsvSink(out / "failures.csv", FAILURE_COLUMNS)

    def note(self, failure: Failure) -> None:
        self.result.failures.append(failure)
        with suppress(OSError):  # a full disk: the failures are still shown at the end
            self.failures.write(vars(failure))

    def look_at(self, picture: InputPicture) -> None:
        start = time.perf_counter()
        color = read_photo(picture.path)
        found = self._detectors.find(color)
        if found and self._segmenter != "none":
            found = self._networks.segmenter(self._segmenter).segment(color, found)
        found = place_keypoints(found)
        self._add(picture.name, color, found)
        scores = tuple(one.confidence for one in found)
        seconds = time.perf_counter() - start
        self.result.pictures.append(DetectedPicture(picture.name, scores, seconds))

    def _add(self, name: str, color_rgb: NDArray[np.uint8], found: tuple[Instance, ...]) -> None:
        self._labels += sorted({one.class_name for one in found} - set(self._labels))
        height, width = color_rgb.shape[:2]
        number = len(self._images) + 1
        self._images.append({"id": number, "file_name": name, "width": width, "height": height})
        for one in found:
            category = self._labels.index(one.class_name) + 1
            head = {"image_id": number, "file_name": name, "category_id": category}
            keypoints = self._detectors.gives_keypoints
            self._entries.append(head | coco_fields(one, keypoints=keypoints))
        if self._options.overlays:
            from cucumbervision.pipeline.overlay import draw_detections

            stem = unique_name(safe_name(str(Path(name).with_suffix(""))), self._taken)
            path = self.result.out / "overlays" / f"{stem}.jpg"
            write_jpeg(path, draw_detections(color_rgb, found), _JPEG_QUALITY)

    def finish(self) -> None:
        info = {
            "description": "Pictures given to cucumbervision detect; results.json has their fruit",
            **software(),
            "started": self._started.isoformat(timespec="seconds"),
            "options": json_value(vars(self._options)),
            "models": self.result.models,
        }
        pictures = {
            "info": info,
            "licenses": [],
            "images": self._images,
            "annotations": [],
            "categories": _coco_categories(self._labels),
        }
        write_json(self.result.out / "images.json", pictures)
        # One entry a line.
        lines = ",\n".join(json.dumps(entry, ensure_ascii=False) for entry in self._entries)
        text = f"[\n{lines}\n]\n" if lines else "[]\n"
        write_bytes(self.result.out / "results.json", text.encode())


def _coco_categories(labels: Sequence[str]) -> list[dict[str, Any]]:
    """Return the classes, numbered from 1, with the five keypoints' names.

    Examples
    --------
    >>> [(c["id"], c["name"]) for c in _coco_categories(["cucumber"])]
    [(1, 'cucumber')]
    """
    skeleton = [[a + 1, b + 1] for a, b in SKELETON]
    return [
        {"id": k, "name": label, "keypoints": list(KEYPOINT_NAMES), "skeleton": skeleton}
        for k, label in enumerate(labels, start=1)
    ]


def coco_fields(one: Instance, *, keypoints: bool) -> dict[str, Any]:
    """Return one fruit's box, score, mask and keypoints as COCO's results have them.

    COCO counts pixels from the picture's corner, so that pixel (0, 0) covers 0 to 1; `keypoints`
    says whether a pose network looked: every entry then has them.
    """
    x1, y1, x2, y2 = (float(edge) for edge in one.box)
    box = [x1 + 0.5, y1 + 0.5, x2 - x1, y2 - y1]
    entry: dict[str, Any] = {
        "bbox": [round(value, 3) for value in box],
        "score": round(one.confidence, 5),
    }
    if one.input_size_px is not None:
        entry["input_size"] = one.input_size_px
    mask = one.detector_mask if one.mask is None else one.mask
    if mask is not None:
        entry["segmentation"] = {"size": list(mask.shape), "counts": encode_rle(mask)}
        entry["mask_source"] = str(one.mask_source or "detector")
    if keypoints:
        points = np.zeros((len(KEYPOINT_NAMES), 3))
        if one.keypoints is not None:
            points = one.keypoints + np.array([0.5, 0.5, 0.0])
        entry["keypoints"] = [round(value, 3) for value in points.ravel().tolist()]
        entry["num_keypoints"] = int(np.count_nonzero(points[:, 2]))
    return entry
