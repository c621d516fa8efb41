"""Instances of one picture from files of annotation tools or another detector."""

from __future__ import annotations

import logging
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
from cucumbervision.fruit.label_files import (
    LabelledImage,
    LabelledInstance,
    entry_or_error,
    read_labels,
)
from cucumbervision.fruit.masks import box_iou

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from cucumbervision.fruit.instance import Instance

_log = logging.getLogger(__name__)

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
        picture = self.find(names, frame)
        if picture is None:
            return FileInstances((), (), ())
        if picture.size_px is not None and picture.size_px != (width, height):
            raise InstancesError(
                f"gives {picture.name or picture.number} the size "
                f"{picture.size_px[0]}x{picture.size_px[1]}, the picture is {width}x{height}",
                source=self.source,
                remedy="give the annotations of this very picture",
            )
        records = [
            record
            for record in picture.records
            if isinstance(record, InstancesError) or not record.is_crowd
        ]
        masks = sum(
            isinstance(record, LabelledInstance) and bool(record.rle or record.polygons)
            for record in records
        )
        if masks * width * height > _MOST_MASK_BYTES:
            raise InstancesError(
                f"has {masks} masks of {width}x{height} pixels in one picture",
                source=self.source,
                remedy=f"at most {_MOST_MASK_BYTES // (width * height)} are read: they would need "
                f"{masks * width * height / 1e9:.0f} GB; give the picture in parts",
            )
        named: list[LabelledInstance] = []
        entries: list[tuple[Instance, bool]] = []
        refused: list[InstancesError] = []
        for record in records:
            if isinstance(record, InstancesError):
                refused.append(record)
                continue
            entry = entry_or_error(record.where, self.source, record.in_picture, width, height)
            if isinstance(entry, InstancesError):
                refused.append(entry)
            else:
                named.append(record)
                entries.append(entry)
        again = _again(named, [instance for instance, _ in entries])
        for later, earlier in again.values():
            words = "%s: %s: %s labels the fruit of %s again, and is left out"
            _log.warning(words, self.source, picture.name, later, earlier)
        entries = [entry for k, entry in enumerate(entries) if k not in again]
        return FileInstances(
            instances=tuple(instance for instance, _ in entries),
            clipped=tuple(cut for _, cut in entries),
            refused=tuple(refused),
        )

    @property
    def crowds(self) -> int:
        """Number of regions of several fruit, which are left out."""
        records = (record for picture in self.pictures for record in picture.records)
        return sum(isinstance(record, LabelledInstance) and record.is_crowd for record in records)

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
        """
        missing, used = [], set[int]()
        for names, frame in captures:
            picture = self.find(names, frame)
            if picture is None:
                missing.append(next((n for n in names if n), str(frame)))
            used.add(id(picture))
        return missing, [
            p.name or f"image id {p.number}" for p in self.pictures if id(p) not in used
        ]

    def find(self, names: Sequence[str], frame: int | None) -> LabelledImage | None:
        """Return the entries for a capture, as for `for_capture`; None if there are none."""
        names = [normalize("NFC", name) for name in names if name]
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


_SAME_FRUIT = 0.85  # intersection over union


def _again(
    records: Sequence[LabelledInstance], instances: Sequence[Instance]
) -> dict[int, tuple[str, str]]:
    """Return the labels of a fruit that an earlier label of its class has, with both places."""
    again: dict[int, tuple[str, str]] = {}
    for k, instance in enumerate(instances):
        for j, earlier in enumerate(instances[:k]):
            if j in again or instance.class_name != earlier.class_name:
                continue
            iou = box_iou(instance.box, earlier.box)
            if iou >= _SAME_FRUIT and instance.mask is not None and earlier.mask is not None:
                shared = np.count_nonzero(instance.mask & earlier.mask)
                iou = shared / np.count_nonzero(instance.mask | earlier.mask)
            if iou >= _SAME_FRUIT:
                again[k] = records[k].where, records[j].where
                break
    return again


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
