"""Instances of one picture from files of annotation tools or another detector.

COCO and YOLO measure from the picture's corner, `Instance` from the first pixel's centre; half a
pixel is subtracted.
"""

from __future__ import annotations

import re
from collections import defaultdict
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING
from unicodedata import normalize
from urllib.parse import unquote

import numpy as np

from cucumbervision.errors import InstancesError
from cucumbervision.instances.instance import Instance, MaskSource
from cucumbervision.instances.label_files import (
    LabelledImage,
    LabelledInstance,
    entry_or_error,
    read_labels,
)
from cucumbervision.instances.mask_codes import mask_of_segmentation
from cucumbervision.instances.masks import box_of_mask

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from numpy.typing import NDArray


_CLIP_SLACK_PX = 0.01  # tolerance for rounded boxes
_MOST_MASK_BYTES = 4_000_000_000  # one byte a pixel


@dataclass(frozen=True, eq=False)
class FileInstances:
    """A file's instances for one picture.

    Parameters
    ----------
    instances : tuple of Instance
        In the file's order; boxes lie within the picture.
    clipped : tuple of bool
        For each instance, whether its box was clipped to the picture.
    refused : tuple of InstancesError
        Errors of unusable entries, with their place in the file.
    """

    instances: tuple[Instance, ...]
    clipped: tuple[bool, ...]
    refused: tuple[InstancesError, ...]


@dataclass(frozen=True, eq=False)
class InstanceFile:
    """A file of instances for many pictures; `read_instances` makes it.

    Parameters
    ----------
    source : str
        The file or folder.
    pictures : tuple of LabelledImage
        Its entries by picture.
    """

    source: str
    pictures: tuple[LabelledImage, ...]

    def for_capture(
        self, names: Sequence[str], width: int, height: int, *, frame: int | None = None
    ) -> FileInstances:
        """Return the instances of one picture.

        Parameters
        ----------
        names : sequence of str
            Possible names of the picture: the capture's name, its colour file. Compared in full,
            then without folder, without extension, and without what label tools add. A folder
            that the file names must be one of the picture's own.
        width, height : int
            The picture's size in pixels.
        frame : int, optional
            The picture's number, compared with COCO's image ids where the file has no names.

        Returns
        -------
        FileInstances
            Empty where the file does not name the picture (`coverage` lists those).

        Raises
        ------
        InstancesError
            If the file names the picture twice, gives it another size, or has more masks of it
            than 4 GB hold.
        """
        picture = self._find([n for n in names if n], frame)
        if picture is None:
            return FileInstances((), (), ())
        if picture.size_px is not None and picture.size_px != (width, height):
            raise InstancesError(
                f"gives {picture.name or picture.number} the size "
                f"{picture.size_px[0]}x{picture.size_px[1]}, the picture is {width}x{height}",
                source=self.source,
                remedy="give the annotations of this very picture",
            )
        masks = sum(
            isinstance(record, LabelledInstance) and bool(record.rle or record.polygons)
            for record in picture.records
        )
        if masks * width * height > _MOST_MASK_BYTES:
            raise InstancesError(
                f"has {masks} masks of {width}x{height} pixels in one picture",
                source=self.source,
                remedy=f"at most {_MOST_MASK_BYTES // (width * height)} are read: they would need "
                f"{masks * width * height / 1e9:.0f} GB; give the picture in parts",
            )
        read = [
            record
            if isinstance(record, InstancesError)
            else entry_or_error(record.where, self.source, _instance, record, width, height)
            for record in picture.records
        ]
        entries = [entry for entry in read if not isinstance(entry, InstancesError)]
        return FileInstances(
            instances=tuple(instance for instance, _ in entries),
            clipped=tuple(cut for _, cut in entries),
            refused=tuple(entry for entry in read if isinstance(entry, InstancesError)),
        )

    def coverage(
        self, captures: Iterable[tuple[Sequence[str], int | None]]
    ) -> tuple[list[str], list[str]]:
        """Return the captures without a picture in the file, and its pictures without a capture.

        Parameters
        ----------
        captures : iterable of (sequence of str, int or None)
            Names and number of each capture, as for `for_capture`.

        Returns
        -------
        missing, unused : list of str
            Names of captures, and of pictures of the file.

        Raises
        ------
        InstancesError
            If several captures have a picture's name: only one of them can be meant.
        """
        missing, used = [], dict[int, str]()
        for names, frame in captures:
            picture = self._find([n for n in names if n], frame)
            capture_name = next((n for n in names if n), str(frame))
            if picture is None:
                missing.append(capture_name)
            elif used.setdefault(id(picture), capture_name) != capture_name:
                raise InstancesError(
                    f"names {picture.name or picture.number} once, which both "
                    f"{used[id(picture)]} and {capture_name} are: one has the other's fruit",
                    source=self.source,
                    remedy="name the pictures with their folders, and measure again",
                )
        return missing, [
            p.name or f"image id {p.number}" for p in self.pictures if id(p) not in used
        ]

    def _find(self, names: Sequence[str], frame: int | None) -> LabelledImage | None:
        names = [normalize("NFC", name) for name in names]
        for short, called in self._by_name.items():
            # A capture's name may contain dots without having an extension.
            keys = {short(n) for n in names} | {_file_name(n) for n in names if short is _stem}
            matches = [
                picture
                for name in keys
                for picture in called.get(name, ())
                if short is str or _in_folder(normalize("NFC", picture.name), names)
            ]
            if len(matches) == 1:
                return matches[0]
            if matches:
                raise InstancesError(
                    f"names {' or '.join(sorted(keys))} {len(matches)} times",
                    source=self.source,
                    remedy="give the pictures different names",
                )
        # A frame number is not a name: if the file has names, its ids mean something else.
        if frame is None or any(p.name for p in self.pictures):
            return None
        return next((p for p in self.pictures if p.number == frame), None)

    @cached_property
    def _by_name(self) -> dict[Callable[[str], str], dict[str, list[LabelledImage]]]:
        """The pictures by their names in full, and by these shortened more and more."""
        shortened: dict[Callable[[str], str], dict[str, list[LabelledImage]]] = {}
        for short in (str, _file_name, _stem, _untagged):
            called = shortened[short] = defaultdict(list)
            for picture in self.pictures:
                if picture.name:
                    called[normalize("NFC", short(picture.name))].append(picture)
        return shortened


def read_instances(path: Path | str) -> InstanceFile:
    """Read COCO JSON, a YOLO txt file, or a folder of YOLO txt files named as their pictures.

    Parameters
    ----------
    path : Path or str
        A .json or .txt file, or a folder (or one that holds `labels/`). Class names of YOLO
        files come from `classes.txt` in the folder.

    Returns
    -------
    InstanceFile
        An outline that is the four corners of a rectangle is a box without a mask.

    Raises
    ------
    InstancesError
        If the file is missing, or has none of these formats.
    """
    path = Path(path)
    return InstanceFile(str(path), tuple(read_labels(path)))


def _instance(record: LabelledInstance, width: int, height: int) -> tuple[Instance, bool]:
    scale = np.array([width, height] if record.normalised else [1, 1], np.float64)
    polygons = [points * scale for points in record.polygons]
    if len(polygons) == 1 and is_rectangle(polygons[0]):  # an oriented box is no outline
        box, clipped = _clip(_around(polygons[0]), width, height)
        mask = None
    else:
        mask = _mask(record, scale, width, height)
        box, clipped = _box(record, polygons, mask, scale, width, height)
    keypoints = None
    if record.keypoints is not None:
        keypoints = record.keypoints.copy()
        keypoints[:, :2] = keypoints[:, :2] * scale - 0.5
    if not 0 <= record.confidence <= 1:
        raise ValueError(f"has the confidence {record.confidence:g}, outside 0 to 1")
    return Instance(
        box=box,
        confidence=record.confidence,
        class_name=record.class_name,
        mask=mask,
        mask_source=None if mask is None else MaskSource.DATASET,
        keypoints=keypoints,
    ), clipped


def _box(
    record: LabelledInstance,
    polygons: Sequence[NDArray[np.float64]],
    mask: NDArray[np.bool_] | None,
    scale: NDArray[np.float64],
    width: int,
    height: int,
) -> tuple[NDArray[np.float64], bool]:
    """Return an instance's box from the first pixel's centre, and whether it was clipped."""
    if record.box is not None:
        return _clip(record.box * np.tile(scale, 2), width, height)
    if mask is None:
        raise ValueError("has neither box nor mask")
    corners = np.concatenate(polygons) if polygons else np.zeros((1, 2))
    return box_of_mask(mask), bool(_outside(corners, width, height).any())


def _around(points: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.concatenate([points.min(axis=0), points.max(axis=0)])


_RIGHT_ANGLE = 0.05  # largest cosine of a rectangle's corner


def is_rectangle(points: NDArray[np.float64]) -> bool:
    """Return whether a polygon is the four corners of a rectangle, which box tools write.

    Examples
    --------
    >>> is_rectangle(np.array([[0.0, 0], [6, 2], [5, 5], [-1, 3], [0, 0]]))
    True
    >>> is_rectangle(np.array([[0.0, 0], [6, 0], [7, 2], [6, 4], [0, 4]]))
    False
    """
    corners = points[:-1] if len(points) == 5 and np.allclose(points[0], points[-1]) else points
    if len(corners) != 4:
        return False
    sides = np.roll(corners, -1, axis=0) - corners
    lengths = np.linalg.norm(sides, axis=1)
    if not (lengths > 0).all():
        return False
    cosines = (sides * np.roll(sides, -1, axis=0)).sum(axis=1) / (lengths * np.roll(lengths, -1))
    return bool((np.abs(cosines) < _RIGHT_ANGLE).all())


def _mask(
    record: LabelledInstance, scale: NDArray[np.float64], width: int, height: int
) -> NDArray[np.bool_] | None:
    shape = record.rle or [(points * scale).ravel() for points in record.polygons]
    return mask_of_segmentation(shape, height, width) if shape else None


def _clip(box: NDArray[np.float64], width: int, height: int) -> tuple[NDArray[np.float64], bool]:
    """Clip a corner-based box to the picture; return it from the first pixel's centre."""
    if box[2] <= box[0] or box[3] <= box[1]:
        raise ValueError("its box has no area")
    corner, opposite = np.maximum(box[:2], 0), np.minimum(box[2:], (width, height))
    if (opposite <= corner).any():
        raise ValueError(f"its box lies outside the picture of {width}x{height}")
    clipped = bool(_outside(box.reshape(2, 2), width, height).any())
    return np.concatenate([corner, opposite]) - 0.5, clipped


def _outside(points: NDArray[np.float64], width: int, height: int) -> NDArray[np.bool_]:
    return (points < -_CLIP_SLACK_PX) | (points > np.array([width, height]) + _CLIP_SLACK_PX)


def _file_name(name: str) -> str:
    return PurePosixPath(name.replace("\\", "/")).name


def _stem(name: str) -> str:
    return PurePosixPath(_file_name(name)).stem


_TAGS = (
    re.compile(r"^[0-9a-f]{8}-(?=.)"),  # Label Studio
    re.compile(r"_(png|jpe?g|bmp|tiff?|webp)\.rf\.[0-9A-Za-z]{16,}$", re.IGNORECASE),  # Roboflow
    re.compile(r"\.(png|jpe?g|bmp|tiff?|webp)$", re.IGNORECASE),  # Supervisely: color_1.png.json
)
# Folders of label tools and data sets, which are not part of a capture's path.
_TOOL_FOLDERS = frozenset(
    {
        *("d", "data", "ds", "export", "image", "images", "img", "input", "label", "labels"),
        *("local-files", "obj_train_data", "obj_valid_data", "test", "train", "upload", "val"),
        "valid",
    }
)


def _untagged(name: str) -> str:
    """Return a name without folder, extension and the additions of label tools.

    Examples
    --------
    >>> _untagged("images/1f3a9c02-color_1.png"), _untagged("color_1.png")
    ('color_1', 'color_1')
    >>> _untagged("color_1_png.rf.0f1e2d3c4b5a69788796a5b4c3d2e1f0.jpg")
    'color_1'
    """
    plain = _stem(unquote(name))
    for tag in _TAGS:
        plain = tag.sub("", plain)
    return plain


def _in_folder(label: str, names: Sequence[str]) -> bool:
    """Return whether the folder in a label's name is a folder of the picture.

    Folders of label tools, numeric folders and pictures without a folder always match.
    """
    folders = PurePosixPath(label.replace("\\", "/")).parts[:-1]
    telling = [f for f in folders if f.lower() not in _TOOL_FOLDERS and not f.isdecimal()]
    parts = {part for name in names for part in PurePosixPath(name.replace("\\", "/")).parts[:-1]}
    return not telling or not parts or telling[-1] in parts
