"""Audited labels of real photos, and recall and precision of the networks on them.

The files in `audit/` contain labels only; the photos are not distributed. Photos are identified by
their hash, so the layout of the folder does not matter. The notes in each file describe how the
boxes were drawn and why a scene belongs to its split.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from cucumbervision.capture.pictures import read_color
from cucumbervision.errors import DataSetError
from cucumbervision.files import read_json
from cucumbervision.fruit.label_files import parse_yolo_line
from cucumbervision.fruit.mask_codes import Rle, fill_polygon
from cucumbervision.fruit.masks import box_iou
from cucumbervision_lab.arrays import Array, Pixels, Progress
from cucumbervision_lab.data.labels import DataSet, Label, LabelledPicture, list_pictures, ticked
from cucumbervision_lab.evaluate.outcomes import Score, detection_rows, fruit_rows, overall
from cucumbervision_lab.evaluate.pictures import Frame, Networks, detect_picture

_AUDIT_FILES = ("photos_audit.json", "photos2_audit.json", "photos3_audit.json")
_HASH_DIGITS = 12
_EDGE_PX = 2.0
_MOST_IGNORED_SHARE = 0.5
_OUTLINES = "labels_seg"
_SAME_IOU = 0.9

FIRST = "first audit"
"""Name of the test with the photos of the first audit, regardless of their setting."""

OTHER_PLANTS = "other plants"
"""Name of the test with tomatoes, gourds, beans and other fruit on the plant."""


def load_audit() -> dict[str, dict[str, Any]]:
    """Read the packaged audit: the entries of the files by the first digits of the photos' SHA-1.

    Each has `name`, `set`, `scene`, `setting` ('trial', the black board of a breeding trial,
    'board', 'plate', 'hand', 'cart', 'crate', 'heap', 'plant', 'ground', 'white', 'parts' if all
    fruit are ignored, 'none' without fruit), `split`, `size`, and `boxes` with `box`, `class`
    ('cucumber', 'zucchini': a fruit of which at least about 70 % is visible; 'ignore'), and, if
    known, `stem`, `ends` and `outline`; and of its set `source`, `licence` and `test`.

    Examples
    --------
    >>> audit = load_audit().values()
    >>> first = [p for p in audit if p["split"] == "test" and audit_test(p) == FIRST]
    >>> sum(box["class"] != "ignore" for photo in first for box in photo["boxes"])
    86
    """
    files = [read_json(Path(__file__).parent / "audit" / name) for name in _AUDIT_FILES]
    sets = {name: values for file in files for name, values in file["sets"].items()}
    photos = [photo | sets[photo["set"]] for file in files for photo in file["photos"]]
    return {photo["sha1"]: photo for photo in photos}


def audit_test(photo: Mapping[str, Any]) -> str:
    """Return the name of the test that a photo belongs to.

    'negatives' for photos without fruit, 'on the plant', or the test of its set.
    """
    named = str(photo.get("test", "loose fruit"))
    if named in (FIRST, OTHER_PLANTS):
        return named
    if not photo["boxes"]:
        return "negatives"
    return "on the plant" if photo["setting"] == "plant" else named


def audited(
    folder: Path,
    split: str = "",
    audit: Mapping[str, Mapping[str, Any]] | None = None,
    *,
    outlines: bool = False,
) -> DataSet:
    """Return the audited photos of a folder as a data set.

    Parameters
    ----------
    folder : Path
        Folder searched recursively for JPEG and PNG files.
    split : str
        'train', 'val', 'test', or '' for all.
    audit : mapping, optional
        Audit to use instead of the packaged one.
    outlines : bool
        Use the publisher's polygons (`labels_seg` next to `images`) as masks if they match the
        audited boxes.

    Returns
    -------
    DataSet
        Data set with one category that includes zucchini. `Label.extras` has 'kind', 'stem' and, if
        known, 'ends_px'; `LabelledPicture.extras` has 'setting', 'collection', 'test' and
        'fully_labelled' (no ignore region is larger than half of the picture: others may contain
        much unlabelled fruit). Files that are not in the audit are skipped.

    Raises
    ------
    DataSetError
        If the folder contains no audited photo.
    """
    book = load_audit() if audit is None else audit
    files: dict[str, Path] = {}
    for path in list_pictures(folder):
        sha1 = hashlib.sha1(path.read_bytes(), usedforsecurity=False).hexdigest()
        files.setdefault(sha1[:_HASH_DIGITS], path)
    pictures = [
        _picture(photo, files[sha1].relative_to(folder).as_posix())
        for sha1, photo in book.items()
        if sha1 in files and split in ("", photo["split"])
    ]
    if not pictures:
        raise DataSetError(
            "contains no audited photo", source=folder, remedy="give the folder with the photos"
        )
    if outlines:
        pictures = [_outlined(picture, folder / picture.file) for picture in pictures]
    return DataSet(folder, tuple(pictures))


def _picture(photo: Mapping[str, Any], file: str) -> LabelledPicture:
    width, height = photo["size"]
    labels = tuple(_label(box, width, height) for box in photo["boxes"])
    limit_px = _MOST_IGNORED_SHARE * width * height
    sides = [label.box[2:] - label.box[:2] for label in labels if label.ignore]
    return LabelledPicture(
        file,
        width,
        height,
        labels,
        scene=photo["scene"],
        split=photo["split"],
        source=photo["source"],
        licence=photo["licence"],
        extras={
            "setting": photo["setting"],
            "collection": photo["set"],
            "test": audit_test(photo),
            "fully_labelled": all(side.prod() <= limit_px for side in sides),
        },
    )


def _label(entry: Mapping[str, Any], width: int, height: int) -> Label:
    """Convert a box; in the file, the origin is the picture's corner, not a pixel's centre."""
    box = np.array(entry["box"]) - 0.5
    x1, y1, x2, y2 = box
    inside = min(x1, y1, width - 1 - x2, height - 1 - y2) + 0.5
    code = None
    if outline := entry.get("outline", ()):
        mask = np.zeros((height, width), np.uint8)
        cv2.fillPoly(mask, [np.array(points, np.int32).reshape(-1, 2) for points in outline], 1)
        code = Rle.of(mask.astype(bool))
    ends = entry.get("ends")
    return Label(
        box,
        mask_code=code,
        pseudo=code is not None,
        cut_off=bool(inside < _EDGE_PX),
        ignore=entry["class"] == "ignore",
        extras={"kind": entry["class"], "stem": entry.get("stem")}
        | ({} if ends is None else {"ends_px": (np.array(ends) - 0.5).tolist()}),
    )


def _outlined(picture: LabelledPicture, path: Path) -> LabelledPicture:
    """Add the best-matching polygon to each fruit as its mask, using each polygon once."""
    file = path.parent.parent / _OUTLINES / f"{path.stem}.txt"
    if path.parent.name != "images" or not file.is_file():
        return picture
    size = np.array([picture.width, picture.height], np.float64)
    shapes = []
    for line in file.read_text(encoding="utf-8").splitlines():
        polygons = parse_yolo_line(line, "", [], (0, 0)).polygons if line.strip() else ()
        masks = [fill_polygon(points * size, picture.height, picture.width) for points in polygons]
        shapes += [Label.of_mask(mask) for mask in masks if mask.any()]
    labels = []
    for label in picture.labels:
        fits = [0.0 if label.ignore else box_iou(label.box, shape.box) for shape in shapes]
        if fits and max(fits) >= _SAME_IOU:
            label = replace(label, mask_code=shapes.pop(int(np.argmax(fits))).mask_code)
        labels.append(label)
    return replace(picture, labels=tuple(labels))


_GREY = 114  # letterbox padding


@dataclass(frozen=True, eq=False)
class PhotoResult:
    """Results of the networks on real photos.

    Parameters
    ----------
    confidence : float
        Confidence threshold.
    data : DataSet
        The evaluated photos.
    frames, small : tuple of Frame
        Labels and detections of each photo, at full and at half size.
    missing : int
        Number of audited photos that are missing.
    """

    confidence: float
    data: DataSet
    frames: tuple[Frame, ...]
    small: tuple[Frame, ...] = ()
    missing: int = 0

    def score(self, *, small: bool = False, **extras: str) -> Score:
        """Compute recall and precision, of all photos or those of a `setting` or a `test`."""
        pairs = zip(self.data.pictures, self.small if small else self.frames, strict=True)
        frames = [frame for photo, frame in pairs if extras.items() <= photo.extras.items()]
        threshold = self.confidence
        return overall(fruit_rows(frames, threshold), detection_rows(frames, threshold))


def audited_photos(folder: Path, split: str = "test") -> tuple[DataSet, int]:
    """Return the audited photos of a folder, and how many of the audit's are missing.

    Parameters
    ----------
    folder : Path
        Folder, searched recursively.
    split : str
        Split of the audit; no network was trained on 'test'.

    Raises
    ------
    DataSetError
        If the folder contains no audited photo.
    """
    data = audited(folder, split)
    count = sum(photo["split"] == split for photo in load_audit().values())
    return data, count - len(data.pictures)


def photo_truth(picture: LabelledPicture) -> Frame:
    """Return the labels of an audited photo for evaluation, with zucchini as optional fruit."""
    labels = tuple(
        replace(
            label,
            mask_code=None,
            keypoints=_keypoints(label.extras.get("ends_px")),
            optional=label.extras["kind"] == "zucchini",
        )
        for label in picture.labels
    )
    return Frame(picture.file, picture.scene, picture.width, picture.height, labels)


def _keypoints(ends_px: Sequence[Sequence[float]] | None) -> Array | None:
    """Return five keypoints of which only the two ends are labelled."""
    if ends_px is None:
        return None
    blossom, stem = np.asarray(ends_px, np.float64)
    line = np.linspace(blossom, stem, 5)
    return np.column_stack([line, [2.0, 0.0, 0.0, 0.0, 2.0]])


def evaluate_photos(
    data: DataSet, networks: Networks, missing: int = 0, report: Progress | None = None
) -> PhotoResult:
    """Run the networks on photos and compute recall and precision.

    Parameters
    ----------
    data : DataSet
        Photos from `audited_photos`.
    networks : Networks
        Networks to evaluate.
    missing : int
        Number of audited photos that are missing.
    report : callable, optional
        Called with 1 after each photo.

    Raises
    ------
    CaptureError
        If a photo cannot be read.
    """
    frames, small = [], []
    for picture in ticked(data.pictures, report):
        color, truth = read_color(data.path(picture)), photo_truth(picture)
        frames.append(detect_picture(truth, color, networks).frame)
        truth, shrunk = half_size(truth, color)
        small.append(detect_picture(truth, shrunk, networks).frame)
    return PhotoResult(networks.confidence, data, tuple(frames), tuple(small), missing)


def half_size(truth: Frame, color: Pixels) -> tuple[Frame, Pixels]:
    """Return a photo at half size, centred in a grey picture of the original size.

    Without the padding, a network would scale the smaller picture up to its input size, so the
    fruit would only be blurred.

    Parameters
    ----------
    truth : Frame
        Labels of the photo.
    color : ndarray of uint8, shape (H, W, 3)
        The photo, RGB.

    Returns
    -------
    truth : Frame
        Labels with transformed boxes and without keypoints.
    color : ndarray of uint8, shape (H, W, 3)
        The padded picture.

    Examples
    --------
    >>> from cucumbervision_lab.data.labels import Label
    >>> from cucumbervision_lab.evaluate.pictures import Frame
    >>> frame = Frame("a.jpg", "s", 8, 4, (Label(np.array([-0.5, -0.5, 7.5, 3.5])),))
    >>> truth, color = half_size(frame, np.zeros((4, 8, 3), np.uint8))
    >>> truth.true[0].box.tolist()
    [1.5, 0.5, 5.5, 2.5]
    >>> color[:, :, 0].tolist()[1]
    [114, 114, 0, 0, 0, 0, 114, 114]
    """
    height, width = color.shape[:2]
    inner = cv2.resize(color, (width // 2, height // 2), interpolation=cv2.INTER_AREA)
    rows, columns = inner.shape[:2]
    top, margin = (height - rows) // 2, (width - columns) // 2
    out = np.full_like(color, _GREY)
    out[top : top + rows, margin : margin + columns] = inner
    gain = np.tile([columns / width, rows / height], 2)
    true_fruit = tuple(
        replace(
            fruit, box=(fruit.box + 0.5) * gain + np.tile([margin, top], 2) - 0.5, keypoints=None
        )
        for fruit in truth.true
    )
    return replace(truth, true=true_fruit), out
