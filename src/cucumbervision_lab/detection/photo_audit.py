"""Manually audited labels of real photos: fruit to be detected, and ignore regions.

The files in `audit/` contain labels only; the photos are not distributed. Photos are identified by
their hash, so the layout of the folder does not matter. The notes in each file describe how the
boxes were drawn and why a scene belongs to its split.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from cucumbervision.errors import DataSetError, wrap_reader_errors
from cucumbervision.files import read_json
from cucumbervision.instances.boxes import box_iou
from cucumbervision.instances.label_files import parse_yolo_line
from cucumbervision.instances.mask_codes import Rle, fill_polygon
from cucumbervision_lab.datasets.labels import DataSet, Label, LabelledPicture, list_pictures

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

_AUDIT_FILES = ("photos_audit.json", "photos2_audit.json", "photos3_audit.json")
_HASH_DIGITS = 12
_EDGE_PX = 2.0
_MOST_IGNORED_SHARE = 0.5
_OUTLINES = "labels_seg"
_SAME_IOU = 0.9

Point = tuple[float, float]

FIRST = "first audit"
"""Name of the test with the photos of the first audit, regardless of their setting."""

OTHER_PLANTS = "other plants"
"""Name of the test with tomatoes, gourds, beans and other fruit on the plant."""


class AuditKind(StrEnum):
    """Kind of an audited box."""

    CUCUMBER = "cucumber"
    ZUCCHINI = "zucchini"
    IGNORE = "ignore"


@dataclass(frozen=True)
class AuditedBox:
    """A fruit or an ignore region.

    Parameters
    ----------
    box : tuple of float
        x1, y1, x2, y2 of the edges in pixels; (0, 0) is the centre of the top-left pixel.
    kind : AuditKind
        CUCUMBER or ZUCCHINI is a fruit of which at least about 70 % is visible. Detections in an
        IGNORE region are neither true nor false positives.
    stem : str, optional
        Side or corner of the box with the stem end: 'left', 'up-right', ...; None if unknown.
    ends : tuple of (float, float), length 2, optional
        Blossom end and stem end of the body without its stalk, u and v in pixels; None if not
        labelled.
    outline : tuple of ndarray of int64, each of shape (K, 2)
        Polygons around the visible parts, in pixels; empty if not labelled.
    """

    box: tuple[float, float, float, float]
    kind: AuditKind
    stem: str | None = None
    ends: tuple[Point, Point] | None = None
    outline: tuple[NDArray[np.int64], ...] = ()

    @property
    def area_px(self) -> float:
        """Area in square pixels."""
        x1, y1, x2, y2 = self.box
        return (x2 - x1) * (y2 - y1)


@dataclass(frozen=True)
class AuditedPhoto:
    """An audited photo.

    Parameters
    ----------
    name : str
        Original file name, for messages only.
    sha1 : str
        First twelve digits of the file's SHA-1.
    collection : str
        Collection of the photo: 'ingredients_ccby4', 'board_cm', 'hand_indoor', ...
    scene : str
        Group of near-duplicates.
    setting : str
        Background of the fruit: 'trial' (the black board of a breeding trial), 'board', 'plate',
        'hand', 'cart', 'crate', 'heap', 'plant', 'ground', 'white'; 'parts' if all fruit are
        ignored; 'none' without fruit.
    split : str
        'train', 'val' or 'test', the same for a whole scene.
    width, height : int
        Size in pixels.
    boxes : tuple of AuditedBox
        Labels; empty for a photo without fruit.
    """

    name: str
    sha1: str
    collection: str
    scene: str
    setting: str
    split: str
    width: int
    height: int
    boxes: tuple[AuditedBox, ...] = ()

    @property
    def whole(self) -> tuple[AuditedBox, ...]:
        """The fruit, without ignore regions."""
        return tuple(box for box in self.boxes if box.kind is not AuditKind.IGNORE)

    @property
    def fully_labelled(self) -> bool:
        """Whether no ignore region is larger than half of the picture.

        Other photos are unsuitable for training, because they may contain much unlabelled fruit.
        """
        limit_px = _MOST_IGNORED_SHARE * self.width * self.height
        return all(b.kind is not AuditKind.IGNORE or b.area_px <= limit_px for b in self.boxes)


@dataclass(frozen=True)
class Audit:
    """All audited photos.

    Parameters
    ----------
    photos : tuple of AuditedPhoto
        Photos ordered by collection and name.
    sets : mapping of str to mapping
        `source`, `licence` and, unless it is 'loose fruit', the name of the `test` of each
        collection.
    """

    photos: tuple[AuditedPhoto, ...]
    sets: Mapping[str, Mapping[str, str]]

    def in_split(self, split: str) -> tuple[AuditedPhoto, ...]:
        """Return the photos of one split, or all for ''."""
        return tuple(photo for photo in self.photos if split in ("", photo.split))

    def test_of(self, photo: AuditedPhoto) -> str:
        """Return the name of the test that a photo belongs to.

        Returns
        -------
        str
            'negatives' for photos without fruit, 'on the plant', or the test of the collection.
        """
        named = self.sets[photo.collection].get("test", "loose fruit")
        if named in (FIRST, OTHER_PLANTS):
            return named
        if not photo.boxes:
            return "negatives"
        if photo.setting == "plant":
            return "on the plant"
        return named


def load_audit() -> Audit:
    """Read the packaged audit.

    Examples
    --------
    >>> audit = load_audit()
    >>> first = [p for p in audit.in_split("test") if audit.test_of(p) == FIRST]
    >>> sum(len(photo.whole) for photo in first), len({p.scene for p in first if p.whole})
    (86, 28)
    """
    folder = Path(__file__).parent / "audit"
    return read_audit([folder / name for name in _AUDIT_FILES])


def read_audit(paths: Sequence[Path]) -> Audit:
    """Read an audit from one or more files.

    Raises
    ------
    DataSetError
        If a file cannot be read or is not an audit.
    """
    files = [read_json(path, DataSetError) for path in paths]
    with wrap_reader_errors(" and ".join(map(str, paths)), DataSetError, "audit the photos again"):
        return _audit(files)


def _audit(files: Sequence[Any]) -> Audit:
    return Audit(
        tuple(_photo(entry) for data in files for entry in data["photos"]),
        {name: entry for data in files for name, entry in data["sets"].items()},
    )


def audited(
    folder: Path, split: str = "", audit: Audit | None = None, *, outlines: bool = False
) -> DataSet:
    """Return the audited photos of a folder as a data set.

    Parameters
    ----------
    folder : Path
        Folder searched recursively for JPEG and PNG files.
    split : str
        'train', 'val', 'test', or '' for all.
    audit : Audit, optional
        Audit to use instead of the packaged one.
    outlines : bool
        Use the publisher's polygons (`labels_seg` next to `images`) as masks if they match the
        audited boxes.

    Returns
    -------
    DataSet
        Data set with one category that includes zucchini. `Label.extras` has 'kind', 'stem' and, if
        known, 'ends_px'; `LabelledPicture.extras` has 'setting', 'collection', 'test' and
        'fully_labelled'. Files that are not in the audit are skipped.

    Raises
    ------
    DataSetError
        If the folder contains no audited photo.
    """
    book = load_audit() if audit is None else audit
    photos = {photo.sha1: photo for photo in book.in_split(split)}
    files: dict[str, Path] = {}
    for path in list_pictures(folder):
        files.setdefault(_sha1(path), path)
    paths = {sha1: files[sha1] for sha1 in photos if sha1 in files}
    if not paths:
        raise DataSetError(
            "contains no audited photo",
            source=folder,
            remedy="give the folder with the photos",
        )
    pictures = [_picture(photos[s], path, folder, book) for s, path in paths.items()]
    if outlines:
        pictures = [_outlined(picture, folder / picture.file) for picture in pictures]
    return DataSet(folder, tuple(pictures))


def _photo(entry: Mapping[str, Any]) -> AuditedPhoto:
    """Parse one photo; in the file, the origin is the picture's corner, not a pixel's centre."""
    boxes = (
        AuditedBox(
            tuple(v - 0.5 for v in b["box"]),
            AuditKind(b["class"]),
            b.get("stem"),
            _ends(b.get("ends")),
            tuple(np.array(points).reshape(-1, 2) for points in b.get("outline", ())),
        )
        for b in entry["boxes"]
    )
    width, height = entry["size"]
    names = ("name", "sha1", "scene", "setting", "split")
    return AuditedPhoto(
        collection=entry["set"],
        width=width,
        height=height,
        boxes=tuple(boxes),
        **{name: entry[name] for name in names},
    )


def _ends(points: list[list[float]] | None) -> tuple[Point, Point] | None:
    if points is None:
        return None
    (blossom_u, blossom_v), (stem_u, stem_v) = points
    return (blossom_u - 0.5, blossom_v - 0.5), (stem_u - 0.5, stem_v - 0.5)


def _sha1(path: Path) -> str:
    return hashlib.sha1(path.read_bytes(), usedforsecurity=False).hexdigest()[:_HASH_DIGITS]


def _picture(photo: AuditedPhoto, path: Path, folder: Path, audit: Audit) -> LabelledPicture:
    return LabelledPicture(
        file=path.relative_to(folder).as_posix(),
        width=photo.width,
        height=photo.height,
        labels=tuple(_label(box, photo) for box in photo.boxes),
        scene=photo.scene,
        split=photo.split,
        source=audit.sets[photo.collection]["source"],
        licence=audit.sets[photo.collection]["licence"],
        extras={
            "setting": photo.setting,
            "collection": photo.collection,
            "test": audit.test_of(photo),
            "fully_labelled": photo.fully_labelled,
        },
    )


def _label(box: AuditedBox, photo: AuditedPhoto) -> Label:
    """Convert a box to a label; fruit at the border of the picture is cut off."""
    x1, y1, x2, y2 = box.box
    inside = min(x1, y1, photo.width - 1 - x2, photo.height - 1 - y2) + 0.5
    mask = np.zeros((photo.height, photo.width), np.uint8)
    cv2.fillPoly(mask, [np.asarray(points, np.int32) for points in box.outline], 1)
    return Label(
        np.array(box.box, np.float64),
        mask_code=Rle.of(mask.astype(bool)) if box.outline else None,
        pseudo=bool(box.outline),
        cut_off=inside < _EDGE_PX,
        ignore=box.kind is AuditKind.IGNORE,
        extras={"kind": str(box.kind), "stem": box.stem}
        | ({} if box.ends is None else {"ends_px": [list(point) for point in box.ends]}),
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
