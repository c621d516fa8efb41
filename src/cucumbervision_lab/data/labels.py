"""Labelled pictures and data sets, and helpers for their files."""

from __future__ import annotations

import math
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any, TypeVar

import numpy as np
from PIL import Image

from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.capture.pictures import COLOR_SUFFIXES, MOST_PIXELS, read_color
from cucumbervision.errors import CucumberVisionError, DataSetError, InstancesError, wrap_os_errors
from cucumbervision.fruit.label_files import LabelledImage, LabelledInstance, entry_or_error
from cucumbervision.fruit.mask_codes import Rle, mask_of_segmentation
from cucumbervision.fruit.masks import box_of_mask, mask_window
from cucumbervision.networks.keypoint_axis import KEYPOINT_SHARES, axis_line
from cucumbervision.tube.shape import points_along
from cucumbervision_lab.arrays import Array, Mask, Progress

KEYPOINT_ORDER = "keypoint_order"
"""Key in a label's extras: 'place' if its keypoints are ordered by position in the picture."""

SPLITS = ("train", "val", "test")
SPLIT_FOLDERS = {"train": "train", "val": "val", "valid": "val", "test": "test"}
"""The split of a folder's pictures, by its name."""

Item = TypeVar("Item")


@dataclass(frozen=True, eq=False)
class Label:
    """Label of one fruit.

    Parameters
    ----------
    box : ndarray of float64, shape (4,)
        x1, y1, x2, y2 of the box's edges in pixels; (0, 0) is the centre of the top-left pixel,
        so a box over the whole picture runs from -0.5 to W - 0.5.
    category : int
        Index into `DataSet.categories`.
    mask_code : Rle, optional
        The visible pixels; `mask` decodes it.
    amodal_code : Rle, optional
        The pixels that would be visible if nothing hid the fruit; `amodal` decodes it.
    keypoints : ndarray of float64, shape (5, 3), optional
        u, v in pixels and visibility 0 (not labelled or outside), 1 (hidden), 2 (seen) of KP0
        (blossom end) to KP4 (stem end).
    hidden_share : float, optional
        Occluded share of the amodal pixels, 0 to 1, if known.
    cut_off : bool
        Whether the fruit extends beyond the picture.
    ignore : bool
        Excluded from training and evaluation, such as a slice or an incompletely labelled crate.
    pseudo : bool
        Whether the mask was predicted by a network.
    optional : bool
        Whether the fruit may be detected once but need not be, such as a zucchini.
    score : float
        Confidence of a detection.
    distance_m : float
        Depth of the fruit's centre, metres; NaN if unknown.
    extras : mapping of str to JSON values
        Further values: centreline_m, thread_m, chord_m, distance_m, tilt_deg, axis_m, radius_m.

    Examples
    --------
    >>> mask = np.zeros((4, 6), bool)
    >>> mask[1, 2:5] = True
    >>> label = Label.of_mask(mask)
    >>> label.box.tolist(), label.mask.sum(), label.amodal is None
    ([1.5, 0.5, 4.5, 1.5], np.int64(3), True)
    """

    box: Array
    category: int = 0
    mask_code: Rle | None = None
    amodal_code: Rle | None = None
    keypoints: Array | None = None
    hidden_share: float | None = None
    cut_off: bool = False
    ignore: bool = False
    pseudo: bool = False
    optional: bool = False
    score: float = 1.0
    distance_m: float = math.nan
    extras: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def of_mask(cls, mask: Mask, *, amodal: Mask | None = None, **rest: Any) -> Label:
        """Create a label from masks; the box is that of the visible mask.

        Parameters
        ----------
        mask : ndarray of bool, shape (H, W)
            The visible pixels, at least one.
        amodal : ndarray of bool, shape (H, W), optional
            The pixels of the complete fruit.
        **rest
            Other fields of the label.

        Raises
        ------
        ValueError
            If the mask is empty.
        """
        code = Rle.of(mask) if mask.any() else None
        amodal_code = None if amodal is None else Rle.of(amodal)
        return cls(box_of_mask(mask), mask_code=code, amodal_code=amodal_code, **rest)

    @property
    def required(self) -> bool:
        """Whether the fruit must be detected."""
        return not (self.ignore or self.optional)

    @property
    def long_px(self) -> float:
        """Longer side of the box, pixels."""
        return float(max(self.box[2:] - self.box[:2]))

    @property
    def mask(self) -> Mask | None:
        """The visible pixels, bool, shape (H, W); decoded on each access."""
        return None if self.mask_code is None else self.mask_code.decode()

    @property
    def amodal(self) -> Mask | None:
        """The pixels of the complete fruit, bool, shape (H, W); decoded on each access."""
        return None if self.amodal_code is None else self.amodal_code.decode()


@dataclass(frozen=True, eq=False)
class LabelledPicture:
    """A picture and its labels.

    Parameters
    ----------
    file : str
        Path relative to the set's folder, with '/': 'images/000001.jpg'.
    width, height : int
        Size in pixels.
    labels : tuple of Label
        Labels; empty for background only.
    scene : str
        Group of near-duplicates; all pictures of a scene belong to one split.
    split : str
        'train', 'val', 'test', or '' if unassigned.
    source : str
        Origin of the picture: 'synth' or a publisher's set.
    licence : str
        Licence stated by the source.
    depth_file : str, optional
        Path relative to the set's folder: 16-bit PNG, 0 = no reading.
    depth_unit_m : float
        Metres per step of `depth_file`.
    camera : Intrinsics, optional
        Intrinsics of the colour camera, to which depth is aligned.
    extras : mapping of str to JSON values
        Further values of the picture.
    """

    file: str
    width: int
    height: int
    labels: tuple[Label, ...] = ()
    scene: str = ""
    split: str = ""
    source: str = ""
    licence: str = ""
    depth_file: str | None = None
    depth_unit_m: float = 0.001
    camera: Intrinsics | None = None
    extras: Mapping[str, Any] = field(default_factory=dict)

    @property
    def shows_fruit(self) -> bool:
        """Whether the picture has a label that is not ignored."""
        return any(not label.ignore for label in self.labels)


@dataclass(frozen=True, eq=False)
class DataSet:
    """Labelled pictures in one folder.

    Parameters
    ----------
    folder : Path
        Folder that picture names are relative to.
    pictures : tuple of LabelledPicture
        Pictures in file order.
    categories : tuple of str
        Class names; `Label.category` is an index into them.
    refused : tuple of CucumberVisionError
        Errors of labels and pictures that a reader skipped.
    """

    folder: Path
    pictures: tuple[LabelledPicture, ...]
    categories: tuple[str, ...] = ("cucumber",)
    refused: tuple[CucumberVisionError, ...] = ()

    def path(self, picture: LabelledPicture) -> Path:
        """Return the path of a picture."""
        return self.folder / picture.file

    def in_split(self, split: str) -> tuple[LabelledPicture, ...]:
        """Return the pictures of one split.

        Examples
        --------
        >>> picture = LabelledPicture("images/a.png", 64, 48, split="val")
        >>> data = DataSet(Path("set"), (picture,))
        >>> len(data.in_split("val")), len(data.in_split("train"))
        (1, 0)
        """
        return tuple(p for p in self.pictures if p.split == split)


def labels_of(
    image: LabelledImage, width: int, height: int, names: Sequence[str], source: Path
) -> tuple[tuple[Label, ...], list[InstancesError]]:
    """Return the labels of a picture of a label file, and the errors of those that are invalid.

    Parameters
    ----------
    image : LabelledImage
        As `instances.label_files` reads it.
    width, height : int
        The picture's size in pixels.
    names : sequence of str
        The categories.
    source : Path
        The label file, for error messages.
    """
    labels: list[Label] = []
    refused: list[InstancesError] = []
    for record in image.records:
        label = (
            record
            if isinstance(record, InstancesError)
            else entry_or_error(record.where, source, _label, record, width, height, names)
        )
        if isinstance(label, InstancesError):
            refused.append(label)
        else:
            labels.append(label)
    return tuple(labels), refused


def _label(record: LabelledInstance, width: int, height: int, names: Sequence[str]) -> Label:
    if record.class_name not in names:
        raise ValueError(f"its category {record.class_name} is not listed")
    size, slack = np.array([width, height]), 1.0  # tools round boxes to whole pixels
    box = np.zeros(4) if record.box is None or record.normalised else record.box
    if (box[:2] < -slack).any() or (box[2:] > size + slack).any():
        raise ValueError(f"its box extends beyond the picture of {width}x{height}")
    instance = record.in_picture(width, height)
    entry, points = record.entry, instance.keypoints
    if points is not None:
        points = points * [1, 1, 2]
        points[points[:, 2] == 0] = 0
    if entry.get("keypoints_px"):
        points = np.array(entry["keypoints_px"], np.float64).reshape(5, 3)
    if points is not None and not np.isin(points[:, 2], (0, 1, 2)).all():
        raise ValueError("a keypoint's visibility is not 0, 1 or 2")
    amodal, hidden = entry.get("amodal_segmentation"), entry.get("hidden_share")
    return Label(
        box=instance.box,
        category=names.index(record.class_name),
        mask_code=None if instance.mask is None else Rle.of(instance.mask),
        amodal_code=Rle.of(mask_of_segmentation(amodal, height, width)) if amodal else None,
        keypoints=points,
        hidden_share=None if hidden is None else float(hidden),
        cut_off=bool(entry.get("cut_off", False)),
        ignore=bool(entry.get("ignore") or record.is_crowd),
        pseudo=bool(entry.get("pseudo", False)),
        extras=dict(entry.get("extras", {})),
    )


def keep_classes(dataset: DataSet, keep: Mapping[str, str]) -> DataSet:
    """Rename and merge classes, and remove all others.

    Parameters
    ----------
    dataset : DataSet
        Data set to change; labels of removed classes become background.
    keep : mapping of str to str
        New name by name, or number from 0, of each class to keep; classes with the same new name
        are merged.

    Raises
    ------
    DataSetError
        If a class does not exist.

    Examples
    --------
    >>> from pathlib import Path
    >>> import numpy as np
    >>> from cucumbervision_lab.data.labels import DataSet, Label, LabelledPicture
    >>> labels = tuple(Label(np.array([0.0, 0, 9, 9]), category=k) for k in (0, 1))
    >>> data = DataSet(Path("x"), (LabelledPicture("a", 64, 48, labels),), ("zucchini", "carrot"))
    >>> cucumbers = keep_classes(data, {"zucchini": "cucumber"})
    >>> cucumbers.categories, len(cucumbers.pictures[0].labels)
    (('cucumber',), 1)
    """
    names = dataset.categories
    unknown = [k for k in keep if k not in names and not (k.isdecimal() and int(k) < len(names))]
    if unknown:
        raise DataSetError(
            f"unknown class {', '.join(unknown)}", remedy=f"use one of {', '.join(names)}"
        )
    categories = tuple(dict.fromkeys(keep.values()))
    new_names = {k: keep.get(name, keep.get(str(k))) for k, name in enumerate(names)}
    index = {k: categories.index(new) for k, new in new_names.items() if new is not None}
    pictures = tuple(
        replace(
            p,
            labels=tuple(
                replace(x, category=index[x.category]) for x in p.labels if x.category in index
            ),
        )
        for p in dataset.pictures
    )
    return replace(dataset, pictures=pictures, categories=categories)


def ticked(items: Iterable[Item], progress: Progress | None) -> Iterator[Item]:
    """Yield items, and call `progress` with 1 after each one."""
    for item in items:
        yield item
        if progress is not None:
            progress(1)


def list_pictures(folder: Path) -> list[Path]:
    """Return all pictures in a folder and its subfolders, sorted."""
    return sorted(p for p in folder.rglob("*") if p.suffix.lower() in COLOR_SUFFIXES)


def picture_size(path: Path) -> tuple[int, int]:
    """Return a picture's width and height; an EXIF orientation is not applied.

    Raises
    ------
    CaptureError
        If the file is missing, is not a picture, or has more than `MOST_PIXELS`.
    """
    # Ultralytics' own `Image.open` asks for a package that reads HEIF, too.
    unreadable = OSError, ImportError, Image.DecompressionBombError
    with suppress(*unreadable), Image.open(path) as picture:
        if picture.width * picture.height <= MOST_PIXELS:
            return picture.size
    height, width = read_color(path).shape[:2]  # names the fault
    return width, height


def flat_names(files: Iterable[str]) -> dict[str, str]:
    """Return a unique name without folders for every file, unique also without the suffix.

    Examples
    --------
    >>> flat_names(["images/a.jpg", "train/a.png", "images/b.jpg"])
    {'images/a.jpg': 'a.jpg', 'train/a.png': 'train_a.png', 'images/b.jpg': 'b.jpg'}
    """
    taken: set[str] = set()
    names: dict[str, str] = {}
    for file in files:
        path = PurePosixPath(file)
        name = path.name
        if path.stem.lower() in taken:
            name = "_".join(part for part in path.parts if part != "images")
        number = 2
        while PurePosixPath(name).stem.lower() in taken:
            name, number = f"{path.stem}_{number}{path.suffix}", number + 1
        taken.add(PurePosixPath(name).stem.lower())
        names[file] = name
    return names


def place_file(source: Path, target: Path) -> None:
    """Create a hard link to a file, or a copy if the file system supports none.

    Raises
    ------
    DataSetError
        If the source is missing or the target cannot be written.
    """
    with wrap_os_errors("cannot be written", target, "choose another folder", DataSetError):
        if not source.is_file():
            raise DataSetError(
                "the file is missing", source=source, remedy="copy the data set again"
            )
        target.parent.mkdir(parents=True, exist_ok=True)
        if target.exists() and target.samefile(source):
            return
        target.unlink(missing_ok=True)
        try:
            os.link(source, target)
        except OSError:  # another disk, or a file system without links
            shutil.copyfile(source, target)


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically.

    Raises
    ------
    DataSetError
        If the file cannot be written.
    """
    part = path.with_name(f"{path.name}.part")
    with wrap_os_errors("cannot be written", path, "choose another folder", DataSetError):
        path.parent.mkdir(parents=True, exist_ok=True)
        part.write_text(text, encoding="utf-8")
        part.replace(path)


def join_parts(parts: Sequence[Array]) -> Array:
    """Join polygons with zero-width bridges across the shortest gaps.

    YOLO files store one polygon per fruit; Ultralytics' converters join parts in the same way.

    Parameters
    ----------
    parts : sequence of ndarray, shape (K, 2)
        At least one polygon, not nested.

    Returns
    -------
    ndarray of float64, shape (N, 2)
        The joined polygon.

    Examples
    --------
    >>> square = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    >>> join_parts([square, square + (3, 0)]).shape
    (10, 2)
    """
    from scipy.spatial import cKDTree

    joined, remaining = parts[0], list(parts[1:])
    while remaining:
        tree = cKDTree(joined)
        neighbours = [tuple(np.asarray(array) for array in tree.query(part)) for part in remaining]
        nearest = int(np.argmin([gaps.min() for gaps, _ in neighbours]))
        gaps, partner = neighbours[nearest]
        part, j = remaining.pop(nearest), int(gaps.argmin())
        i = int(partner[j])
        joined = np.concatenate([joined[: i + 1], part[j:], part[: j + 1], joined[i:]])
    return joined


def one_polygon(mask: Mask, min_part_px: float = 16.0) -> Array | None:
    """Return a mask as a single polygon without small parts.

    Parameters
    ----------
    mask : ndarray of bool, shape (H, W)
        The mask.
    min_part_px : float
        Minimum area of a part, pixels; the largest part is always kept.

    Returns
    -------
    ndarray of float64, shape (K, 2), or None
        Polygon in pixels from the picture's corner; None for an empty mask.

    Examples
    --------
    >>> one_polygon(np.zeros((4, 6), bool)) is None
    True
    """
    import cv2

    window = mask_window(mask)
    if window is None:
        return None
    # A grid of half pixels, so that outlines run along the pixels' edges. They cut off corners of
    # single pixels: readers take four corners for a box.
    part = np.pad(mask[window], 1).astype(np.uint8)
    corners = part[1:, 1:] + part[:-1, 1:] + part[1:, :-1] + part[:-1, :-1]
    fine = cv2.dilate(part.repeat(2, 0).repeat(2, 1), np.ones((2, 2), np.uint8))[2:-1, 2:-1]
    fine[::2, ::2] = corners > 1
    outlines, _ = cv2.findContours(fine, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    first, *smaller = sorted(outlines, key=cv2.contourArea, reverse=True)
    large = [first, *(part for part in smaller if cv2.contourArea(part) >= 4 * min_part_px)]
    corner = np.array([window[1].start, window[0].start], np.float64)
    return join_parts([part.reshape(-1, 2) / 2 + corner for part in large])


DIRECTIONS = {
    "right": (1.0, 0.0),
    "left": (-1.0, 0.0),
    "down": (0.0, 1.0),
    "up": (0.0, -1.0),
    "down-right": (1.0, 1.0),
    "down-left": (-1.0, 1.0),
    "up-right": (1.0, -1.0),
    "up-left": (-1.0, -1.0),
}
"""Directions of the stem end by name, as (x, y) with y down."""


def keypoints_of_mask(mask: Mask, stem: str) -> Array | None:
    """Return keypoints along the axis of a mask.

    Parameters
    ----------
    mask : ndarray of bool, shape (H, W)
        Mask of a complete fruit.
    stem : str
        Direction of the stem end from the fruit's centre, one of `DIRECTIONS`.

    Returns
    -------
    ndarray of float64, shape (5, 3), or None
        u, v in pixels and visibility 2 of KP0 (blossom end) to KP4 (stem end), evenly spaced along
        the axis. None if the mask is too small, too round or too strongly bent, or the axis is
        nearly perpendicular to `stem`.

    Raises
    ------
    ValueError
        If `stem` is not in `DIRECTIONS`.

    Examples
    --------
    >>> mask = np.zeros((40, 100), bool)
    >>> mask[15:25, 10:91] = True
    >>> keypoints_of_mask(mask, "left")[:, 0].round().tolist()
    [90.0, 70.0, 50.0, 30.0, 10.0]
    """
    if stem not in DIRECTIONS:
        raise ValueError(f"unknown direction {stem!r}: use one of {', '.join(DIRECTIONS)}")
    line = axis_line(mask)
    if line is None:
        return None
    towards = float((line[-1] - line[0]) @ np.array(DIRECTIONS[stem]))
    norm = float(np.linalg.norm(line[-1] - line[0]) * np.linalg.norm(DIRECTIONS[stem]))
    if abs(towards) < 0.25 * norm:
        return None
    points = points_along(line if towards > 0 else line[::-1], KEYPOINT_SHARES)
    return np.column_stack([points, np.full(len(points), 2.0)])
