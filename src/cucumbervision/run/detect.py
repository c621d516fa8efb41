"""Find cucumbers in plain images: no depth, no lengths."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from cucumbervision.about import software
from cucumbervision.capture.frames import Capture
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.capture.pictures import PHOTO_SUFFIXES, read_photo, write_jpeg
from cucumbervision.capture.source import CaptureRef, safe_name, unique_name
from cucumbervision.errors import CaptureError, wrap_os_errors
from cucumbervision.files import write_bytes, write_csv, write_json
from cucumbervision.fruit.instance import KEYPOINT_NAMES, SKELETON, Instance
from cucumbervision.fruit.mask_codes import encode_rle
from cucumbervision.networks.registry import Registry
from cucumbervision.run.batch import Item, Worker, in_turn, measure_all
from cucumbervision.run.measurer import Boundary, Failure, Measurer, exit_code
from cucumbervision.run.options import MeasureOptions
from cucumbervision.run.overlay import draw_detections
from cucumbervision.run.tables import FAILURE_COLUMNS

_JPEG_QUALITY = 90


def find_pictures(
    inputs: Sequence[str | Path], leave_out: Path | None = None
) -> tuple[list[Item], int]:
    """List the images among files and in folders, including subfolders.

    A named file counts as an image with any extension; in folders the extension decides, and
    hidden files are skipped.

    Parameters
    ----------
    inputs : sequence of str or Path
        Files and folders given by the user.
    leave_out : Path, optional
        Folder to exclude, such as that of the results.

    Returns
    -------
    items : list of CaptureRef or Failure
        Each file once, in the order of the inputs, sorted within a folder; a failure for each input
        without images.
    skipped : int
        Number of files in folders whose extension is not that of an image.

    Examples
    --------
    >>> import tempfile
    >>> folder = Path(tempfile.mkdtemp())
    >>> for name in ("b.JPG", "a.png", "notes.txt"):
    ...     _ = (folder / name).write_bytes(b"")
    >>> pictures, skipped = find_pictures([folder, folder / "b.JPG"])
    >>> [picture.name for picture in pictures], skipped
    (['a.png', 'b.JPG'], 1)
    """
    apart = None if leave_out is None else leave_out.resolve()
    taken, names = set[Path](), set[str]()
    items: list[Item] = []
    skipped = 0
    for entry in map(Path, inputs):
        fault, remedy = "does not exist", "check the path"
        pictures = [(entry, entry.name)] if entry.exists() else []
        if entry.is_dir():
            fault = "there are no images"
            remedy = "name JPEG, PNG, WebP, TIFF or BMP files, or a folder with some"
            files = [path for path in _files_below(entry) if apart not in path.resolve().parents]
            pictures = [
                (path, path.relative_to(entry).as_posix())
                for path in files
                if path.suffix.lower() in PHOTO_SUFFIXES
            ]
            skipped += len(files) - len(pictures)
        if not pictures:
            error = CaptureError(fault, source=entry, remedy=remedy)
            items.append(Failure.of(error, str(entry)))
        for path, inner_name in pictures:
            if (resolved := path.resolve()) in taken:
                continue
            choices = (inner_name, path.as_posix())
            name = next((choice for choice in choices if choice not in names), str(resolved))
            taken.add(resolved)
            names.add(name)
            items.append(CaptureRef(name, 0, partial(read_picture, path, name), input=str(path)))
    return items, skipped


def read_picture(path: Path, name: str) -> Capture:
    """Read a plain image as a capture without depth; detectors use only its colour."""
    color = read_photo(path)
    height, width = color.shape[:2]
    lens = Intrinsics(width, height, float(width), float(width), width / 2, height / 2)
    return Capture(color, np.zeros((height, width), np.float32), lens, name, source=str(path))


def _files_below(folder: Path) -> list[Path]:
    names = (path.relative_to(folder) for path in sorted(folder.rglob("*")) if path.is_file())
    return [folder / name for name in names if not any(p.startswith(".") for p in name.parts)]


@dataclass(frozen=True, eq=False)
class DetectedPicture:
    """An image and its fruit: fields of COCO's results, with a class name for its number."""

    name: str
    width: int
    height: int
    fruit: list[dict[str, Any]]


class PictureWorker(Worker[DetectedPicture]):
    """Finds the fruit of plain images, and draws them into a folder if one is given."""

    def __init__(self, measurer: Measurer, out: Path | None = None) -> None:
        super().__init__(measurer)
        self._out = out
        self._taken: set[str] = set()
        self.labels: dict[str, None] = {}
        self.failures: list[Failure] = []  # of overlays that could not be written

    def measure(self, capture: Capture) -> DetectedPicture | Failure:
        """Return the detections; nothing is measured."""
        self.measurer.load()
        failures: list[Failure] = []
        with Boundary(failures, capture.source, capture.name):
            _, detections = self.measurer.detect(capture)
        if failures:
            return failures[0]
        fruit = [
            coco_fields(instance, keypoints=detections.posed) | {"class": instance.class_name}
            for instance in detections.instances
        ]
        found = sorted({instance["class"] for instance in fruit})
        self.labels |= dict.fromkeys((*detections.labels, *found))
        if self._out is not None:
            with Boundary(self.failures, capture.source, capture.name):
                stem = unique_name(safe_name(str(Path(capture.name).with_suffix(""))), self._taken)
                drawn = draw_detections(capture.color, detections.instances)
                write_jpeg(self._out / f"{stem}.jpg", drawn, _JPEG_QUALITY)
        return DetectedPicture(capture.name, capture.width, capture.height, fruit)


@dataclass(frozen=True, eq=False)
class DetectResult:
    """Result of a run.

    Parameters
    ----------
    pictures : list of DetectedPicture
        The images, in order.
    failures : list of Failure
        Images that could not be read.
    skipped : int
        Number of files in folders that are not images.
    models : list of dict
        Name, SHA-256 and runtime of each network.
    out : Path
        Output folder.
    """

    pictures: list[DetectedPicture] = field(default_factory=list)
    failures: list[Failure] = field(default_factory=list)
    skipped: int = 0
    models: list[dict[str, Any]] = field(default_factory=list)
    out: Path = Path()

    @property
    def exit_code(self) -> int:
        """The exit code of the command: 0, 1, 2 or 70, as in `measurer.exit_code`."""
        return exit_code(len(self.pictures), self.failures)


Report: TypeAlias = Callable[[int, int], None]


def detect_inputs(
    inputs: Sequence[str | Path],
    out: Path,
    options: MeasureOptions | None = None,
    report: Report | None = None,
    registry: Registry | None = None,
) -> DetectResult:
    """Find the fruit in every image, and write the detections to a folder.

    `out` gets `results.json` (COCO results), `images.json` (the images, classes and provenance
    as a COCO data set without annotations), `failures.csv`, and `overlays/` with one annotated
    JPEG per image. An image that cannot be read is reported, and the others are processed. An
    interrupted run keeps its results.

    Parameters
    ----------
    inputs : sequence of str or Path
        Files, folders and patterns.
    out : Path
        Output folder, created if missing; images in it are excluded.
    options : MeasureOptions, optional
        Options of the run; those for measuring are ignored.
    report : callable, optional
        Called with the number of images done and their total; for progress bars.
    registry : Registry, optional
        Registry of named networks; by default that of the package.

    Returns
    -------
    DetectResult

    Raises
    ------
    CucumberVisionError
        If the run cannot start: a network that cannot be loaded, or a folder that cannot be
        written.
    """
    started = datetime.now(UTC)
    items, skipped = find_pictures(inputs, leave_out=out)
    options = options or MeasureOptions()
    if options.instances == "auto":  # plain images have no masks of a data set
        options = replace(options, instances="models")
    measurer = Measurer(options, registry)
    models, worker = measurer.load().networks.models, PictureWorker(measurer, out / "overlays")
    result = DetectResult(failures=worker.failures, skipped=skipped, models=models, out=out)
    with wrap_os_errors("cannot be written", out):
        (out / "overlays").mkdir(parents=True, exist_ok=True)
    try:
        for done, (_, answer) in enumerate(measure_all(items, worker, in_turn), start=1):
            if isinstance(answer, DetectedPicture):
                result.pictures.append(answer)
            elif answer is not None:
                result.failures.append(answer)
            if report is not None:
                report(done, len(items))
    finally:
        _write(result, list(worker.labels), options, started)
    return result


def _write(
    result: DetectResult, labels: list[str], options: MeasureOptions, started: datetime
) -> None:
    images, lines = [], []
    for number, picture in enumerate(result.pictures, start=1):
        size = {"width": picture.width, "height": picture.height}
        images.append({"id": number, "file_name": picture.name, **size})
        for fruit in picture.fruit:
            fields = {key: value for key, value in fruit.items() if key != "class"}
            category = labels.index(fruit["class"]) + 1
            head = {"image_id": number, "file_name": picture.name, "category_id": category}
            lines.append(json.dumps(head | fields, ensure_ascii=False))
    info = {
        "description": "Images given to cucumbervision detect; results.json has their fruit",
        **software(),
        "started": started.isoformat(timespec="seconds"),
        "options": options.as_json(),
        "models": result.models,
    }
    skeleton = [[a + 1, b + 1] for a, b in SKELETON]
    categories = [
        {"id": k, "name": label, "keypoints": list(KEYPOINT_NAMES), "skeleton": skeleton}
        for k, label in enumerate(labels, start=1)
    ]
    coco = {"info": info, "licenses": [], "images": images, "annotations": []}
    with wrap_os_errors("cannot be written", result.out):
        write_json(result.out / "images.json", {**coco, "categories": categories})
        write_csv(result.out / "failures.csv", FAILURE_COLUMNS, map(vars, result.failures))
    # One entry a line.
    text = ",\n".join(lines)
    write_bytes(result.out / "results.json", (f"[\n{text}\n]\n" if lines else "[]\n").encode())


def coco_fields(instance: Instance, *, keypoints: bool) -> dict[str, Any]:
    """Return box, score, mask and keypoints of one fruit in the format of COCO results.

    COCO counts pixels from the image's corner, so that pixel (0, 0) covers 0 to 1. With
    `keypoints` every entry has keypoints, because a network looked for them.
    """
    x1, y1, x2, y2 = (float(edge) for edge in instance.box)
    box = [x1 + 0.5, y1 + 0.5, x2 - x1, y2 - y1]
    entry: dict[str, Any] = {
        "bbox": [round(value, 3) for value in box],
        "score": round(instance.confidence, 5),
    }
    if instance.input_size_px is not None:
        entry["input_size"] = instance.input_size_px
    mask = instance.detector_mask if instance.mask is None else instance.mask
    if mask is not None:
        entry["segmentation"] = {"size": list(mask.shape), "counts": encode_rle(mask)}
        entry["mask_source"] = str(instance.mask_source or "detector")
    if keypoints:
        points = np.zeros((len(KEYPOINT_NAMES), 3))
        if instance.keypoints is not None:
            points = instance.keypoints + np.array([0.5, 0.5, 0.0])
        entry["keypoints"] = [round(value, 3) for value in points.ravel().tolist()]
        entry["num_keypoints"] = int(np.count_nonzero(points[:, 2]))
    return entry
