"""Read COCO and YOLO labels: one typed result for `--instances` and for data sets.

Both formats measure from the picture's corner, `Instance` from the first pixel's centre; half a
pixel is subtracted.
"""

from __future__ import annotations

import logging
import re
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Any, TypeVar
from unicodedata import normalize
from urllib.parse import unquote

import numpy as np

from cucumbervision.arrays import Array
from cucumbervision.errors import CucumberVisionError, InstancesError, wrap_reader_errors
from cucumbervision.files import read_json, read_text
from cucumbervision.fruit.instance import Instance, MaskSource, in_picture
from cucumbervision.fruit.mask_codes import mask_of_segmentation, polygon_points
from cucumbervision.fruit.masks import box_iou, box_of_mask

_T = TypeVar("_T")
_log = logging.getLogger(__name__)
_MOST_MASK_BYTES = 4_000_000_000  # one byte a pixel
_KEYPOINTS = 5
_SLACK = 1e-6  # tolerance outside 0 to 1 for rounded numbers
_CLIP_SLACK_PX = 0.01  # tolerance for rounded boxes
_RIGHT_ANGLE = 0.05  # largest cosine of a rectangle's corner
# Keypoints run through their box from end to end; the points of an outline return, and do not lie
# about the first of them.
_NO_KEYPOINTS = 0, 0
_IN_BOX, _SPANS_BOX, _ALONG, _OFF_CENTRE = 0.55, 0.7, 0.85, 0.15


@dataclass(frozen=True, eq=False, kw_only=True)
class LabelledInstance:
    """One instance as written in a file.

    Parameters
    ----------
    where : str
        Place in the file, for errors: 'annotation 7', 'line 3'.
    class_name : str
        Class name.
    confidence : float
        Confidence, 0 to 1.
    box : ndarray, shape (4,), optional
        x1, y1, x2, y2 from the picture's corner.
    polygons : tuple of ndarray, shape (K, 2)
        Outlines, from the picture's corner.
    rle : mapping, optional
        COCO run lengths: counts and size.
    keypoints : ndarray, shape (5, 3), optional
        x, y from the picture's corner and visibility 0 to 1.
    normalised : bool
        True where x and y are shares of the picture's width and height.
    is_crowd : bool
        True for a region of several fruit.
    entry : mapping
        The entry as in a COCO file; `kpt_shape` of keypoints without visibility in YOLO.
    """

    where: str
    class_name: str
    confidence: float = 1.0
    box: Array | None = None
    polygons: tuple[Array, ...] = ()
    rle: Mapping[str, Any] | None = None
    keypoints: Array | None = None
    normalised: bool = False
    is_crowd: bool = False
    entry: Mapping[str, Any] = field(default_factory=dict)

    def in_picture(self, width: int, height: int) -> Instance:
        """Return the instance in an image of this size, with its box clipped to it.

        An outline that is the four corners of a rectangle is a box without a mask.

        Raises
        ------
        InstancesError, ValueError, KeyError, TypeError, OverflowError
            If box or mask do not fit the picture, or the confidence is outside 0 to 1.
        """
        scale = np.array([width, height] if self.normalised else [1, 1], np.float64)
        polygons = [points * scale for points in self.polygons]
        corners = np.concatenate(polygons) if polygons else np.zeros((1, 2))
        box, mask = None if self.box is None else self.box * np.tile(scale, 2), None
        outer = np.concatenate([corners.min(axis=0), corners.max(axis=0)])
        if len(polygons) == 1 and is_rectangle(polygons[0]):  # an oriented box is no outline
            box = outer
        elif self.rle or polygons:
            shape = self.rle or [points.ravel() for points in polygons]
            mask = mask_of_segmentation(shape, height, width)
        if box is None and mask is None:
            raise ValueError("has neither box nor mask")
        outer = outer if box is None else box
        size = np.array([width, height]) + _CLIP_SLACK_PX
        is_clipped = (outer[:2] < -_CLIP_SLACK_PX).any() or (outer[2:] > size).any()
        keypoints = None
        if self.keypoints is not None:
            keypoints = self.keypoints.copy()
            keypoints[:, :2] = keypoints[:, :2] * scale - 0.5
        instance = Instance(
            box=box_of_mask(mask) if box is None and mask is not None else outer - 0.5,
            confidence=self.confidence,
            class_name=self.class_name,
            mask=mask,
            mask_source=None if mask is None else MaskSource.DATASET,
            keypoints=keypoints,
            is_clipped=bool(is_clipped),
        )
        return in_picture(instance, width, height)


@dataclass(frozen=True, eq=False)
class LabelledImage:
    """A file's entries for one picture.

    Parameters
    ----------
    name : str
        File name, or '' where the file gives only a number.
    number : int, optional
        COCO's image id.
    size_px : tuple of int, optional
        Width and height, where the file gives them.
    records : list of LabelledInstance or InstancesError
        Its instances, or the error of each unreadable one.
    entry : mapping
        The image as in a COCO file.
    """

    name: str
    number: int | None
    size_px: tuple[int, int] | None
    records: list[LabelledInstance | InstancesError] = field(default_factory=list)
    entry: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class InstanceFile:
    """A file of instances for many images; `read_instances` makes it.

    Parameters
    ----------
    source : str
        The file or folder.
    pictures : list of LabelledImage
        Its entries by image.
    class_names : list of str
        Its classes, without groups of classes.
    refused : list of InstancesError
        Errors of unreadable images.
    """

    source: str
    pictures: list[LabelledImage]
    class_names: list[str] = field(default_factory=list)
    refused: list[InstancesError] = field(default_factory=list)

    def for_capture(
        self, names: Sequence[str], width: int, height: int, *, frame: int | None = None
    ) -> tuple[tuple[Instance, ...], tuple[InstancesError, ...]]:
        """Return the instances of one image, and the errors of its unusable entries.

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
        instances : tuple of Instance
            In the file's order, clipped to the image; empty where the file does not name it.
        refused : tuple of InstancesError
            With the place of each entry in the file.

        Raises
        ------
        InstancesError
            If the file names the picture twice, gives it another size, or has more masks of it
            than 4 GB hold.
        """
        picture = self.find(names, frame)
        if picture is None:
            return (), ()
        name, size = picture.name or picture.number, f"{width}x{height}"
        if picture.size_px is not None and picture.size_px != (width, height):
            own = "x".join(map(str, picture.size_px))
            fault = f"gives {name} the size {own}, the picture is {size}"
            remedy = "give the annotations of this very picture"
            raise InstancesError(fault, source=self.source, remedy=remedy)
        records = [x for x in picture.records if isinstance(x, LabelledInstance) and not x.is_crowd]
        masks = sum(bool(record.rle or record.polygons) for record in records)
        most_masks = _MOST_MASK_BYTES // (width * height)
        if masks > most_masks:
            fault = f"has {masks} masks of {size} pixels in one picture"
            remedy = f"at most {most_masks} are read; give the picture in parts"
            raise InstancesError(fault, source=self.source, remedy=remedy)
        refused = [record for record in picture.records if isinstance(record, InstancesError)]
        entries: list[tuple[str, Instance]] = []
        for record in records:
            entry = entry_or_error(record.where, self.source, record.in_picture, width, height)
            if isinstance(entry, InstancesError):
                refused.append(entry)
            else:
                entries.append((record.where, entry))
        single = []
        for number, (where, instance) in enumerate(entries):
            other, is_same = _label_of_same(number, entries)
            if not is_same:
                single.append(instance)
            if other:
                words = "the fruit of %s again, and is left out" if is_same else "part of %s too"
                place = self.source, picture.name, where, other
                _log.warning(f"%s: %s: %s labels {words}; label each fruit once", *place)
        return tuple(single), tuple(refused)

    @property
    def crowds(self) -> int:
        """Number of regions of several fruit, which are left out."""
        records = (record for picture in self.pictures for record in picture.records)
        return sum(isinstance(record, LabelledInstance) and record.is_crowd for record in records)

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
                fault = f"names {' or '.join(sorted(keys))} {len(matches)} times"
                remedy = "give the pictures different names"
                raise InstancesError(fault, source=self.source, remedy=remedy)
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
        If the file is missing, has none of these formats, or one of its images cannot be read.
    """
    path = Path(path)
    if path.is_dir():
        for place in (path, path / "labels"):
            if files := sorted(f for f in place.glob("*.txt") if f.name != "classes.txt"):
                names = _yolo_classes(place) or _yolo_classes(path)
                return _read_yolo(path, files, names)
        raise InstancesError("holds no label files", source=path, remedy="give YOLO txt files")
    if not path.is_file():
        raise InstancesError("there is no such file", source=path, remedy="check the path")
    if path.suffix.lower() == ".json":
        labels = parse_coco(read_json(path, InstancesError), path)
        if labels.refused:
            raise labels.refused[0]
        return labels
    if path.suffix.lower() == ".txt":
        return _read_yolo(path, [path], _yolo_classes(path.parent))
    raise InstancesError("unknown kind of file", source=path, remedy="give COCO JSON or YOLO txt")


# Intersection over union of boxes; share of a mask in a larger one.
_SAME_FRUIT, _INSIDE, _IN_PART = 0.85, 0.8, 0.3


def _label_of_same(number: int, entries: Sequence[tuple[str, Instance]]) -> tuple[str, bool]:
    """Return the place of a larger or earlier label of the same fruit, and whether of all of it."""
    instance, in_part = entries[number][1], ""
    for k, (where, other) in enumerate(entries):
        iou = box_iou(instance.box, other.box)
        if k == number or iou == 0 or instance.class_name != other.class_name:
            continue
        is_same = k < number and iou >= _SAME_FRUIT
        if instance.mask is not None and other.mask is not None:
            own, others = np.count_nonzero(instance.mask), np.count_nonzero(other.mask)
            shared = np.count_nonzero(instance.mask & other.mask)
            is_same = bool(shared >= _INSIDE * own and (others, number) > (own, k))
            if k < number and shared >= _IN_PART * min(own, others):
                in_part = where
        if is_same:
            return where, True
    return in_part, False


def parse_coco(data: Any, path: Path) -> InstanceFile:
    """Parse COCO annotations (a dict of images and annotations) or results (a list).

    Raises
    ------
    InstancesError
        If it is neither of the two.
    """
    is_annotated = isinstance(data, dict)
    items = data.get("annotations") if is_annotated else data
    images = data.get("images", []) if is_annotated else []
    if not isinstance(items, list) or not isinstance(images, list):
        raise InstancesError("has no annotations", source=path, remedy="give COCO JSON")
    with wrap_reader_errors(path, InstancesError, "give COCO JSON"):
        categories = [c for c in data.get("categories", ()) if "id" in c] if is_annotated else []
        names = {c["id"]: str(c.get("name", c["id"])) for c in categories}
        used = {item.get("category_id") for item in items if isinstance(item, dict)}
        groups = {c.get("supercategory") for c in categories} if len(names) > 1 else set()
        ids = [i for i in sorted(names, key=int) if names[i] not in groups or i in used]
    pictures: dict[str, LabelledImage] = {}
    refused: list[InstancesError] = []
    for i, image in enumerate(images):
        place = f"image {image.get('id', i) if isinstance(image, dict) else i}"
        picture = entry_or_error(place, path, _coco_image, image)
        if isinstance(picture, InstancesError):
            refused.append(picture)
        else:
            pictures[str(image["id"])] = picture
    for i, item in enumerate(items):
        where = f"annotation {item.get('id', i) if isinstance(item, dict) else i}"
        if not isinstance(item, dict) or not {"image_id", "file_name"} & set(item):
            fault = f"{where} names no picture"
            refused.append(InstancesError(fault, source=path, remedy="give COCO JSON"))
            continue
        name = str(item.get("file_name", ""))
        key, number = str(item.get("image_id", name)), _number(item.get("image_id"))
        picture = pictures.setdefault(key, LabelledImage(name, number, None))
        record = entry_or_error(where, path, _coco_record, item, where, names, is_annotated)
        picture.records.append(record)
    class_names = list(dict.fromkeys(names[i] for i in ids))
    return InstanceFile(str(path), list(pictures.values()), class_names, refused)


def _coco_image(image: Any) -> LabelledImage:
    size = None
    if {"width", "height"} <= set(image):  # some tools write them as text
        size = int(float(image["width"])), int(float(image["height"]))
    number = _number(image["id"])
    return LabelledImage(str(image.get("file_name", "")), number, size, entry=image)


def _number(value: Any) -> int | None:
    return int(value) if isinstance(value, int) or str(value).isdecimal() else None


def _coco_record(
    item: Mapping[str, Any], where: str, names: Mapping[Any, str], is_annotated: bool
) -> LabelledInstance:
    box = None
    if item.get("bbox"):
        x, y, w, h = _finite(item["bbox"])
        box = np.array([x, y, x + w, y + h])
    shape = item.get("segmentation") or []
    polygons = () if isinstance(shape, dict) else tuple(polygon_points(p) for p in shape)
    if box is None and not shape:
        raise ValueError("has neither box nor mask")
    keypoints = None
    if item.get("keypoints"):
        keypoints = _keypoints(_finite(item["keypoints"]), 2.0 if is_annotated else 1.0)
    category = item.get("category_id", 0)
    return LabelledInstance(
        where=where,
        class_name=names.get(category, str(category)),
        confidence=float(_finite([item.get("score", 1.0)])[0]),
        box=box,
        polygons=polygons,
        rle=shape if isinstance(shape, dict) else None,
        keypoints=keypoints,
        is_crowd=bool(item.get("iscrowd")),
        entry=item,
    )


def _yolo_classes(folder: Path) -> list[str]:
    """Read the class names from `classes.txt` beside the labels; empty without one."""
    path = folder / "classes.txt"
    return read_text(path, InstancesError).split("\n") if path.is_file() else []


def _read_yolo(source: Path, files: Sequence[Path], names: Sequence[str]) -> InstanceFile:
    pictures = [read_yolo_file(file, names) for file in files]
    records = [r for p in pictures for r in p.records if isinstance(r, LabelledInstance)]
    # Of few points, one outline in some hundred looks like keypoints without visibility.
    if any(r.polygons for r in records) and any(r.entry for r in records):
        pictures = [read_yolo_file(file, names, _NO_KEYPOINTS) for file in files]
    return InstanceFile(str(source), pictures)


def read_yolo_file(
    path: Path, names: Sequence[str], kpt_shape: tuple[int, int] | None = None
) -> LabelledImage:
    """Read the labels of one picture; the parameters are those of `parse_yolo_line`.

    Raises
    ------
    InstancesError
        If the file is missing or is no text.
    """
    lines = read_text(path, InstancesError).split("\n")
    records = [
        entry_or_error(f"line {i}", path, parse_yolo_line, line, f"line {i}", names, kpt_shape)
        for i, line in enumerate(lines, 1)
        if line.strip()
    ]
    return LabelledImage(path.name, None, None, records)


def parse_yolo_line(
    line: str, where: str, names: Sequence[str], kpt_shape: tuple[int, int] | None = None
) -> LabelledInstance:
    """Read one line of a YOLO label file.

    Parameters
    ----------
    line : str
        'class cx cy w h', a polygon 'class x1 y1 x2 y2 x3 y3 ...', or a box with keypoints of two
        or three numbers 'class cx cy w h x y v ...', of which five are read; a confidence may
        follow. Coordinates are shares of the picture.
    where : str
        Place in the file, for errors.
    names : sequence of str
        Class names; the class number replaces a missing one.
    kpt_shape : tuple of int, optional
        Number of keypoints and of numbers a keypoint, (0, 0) for none, if the data set states it.

    Returns
    -------
    LabelledInstance

    Raises
    ------
    ValueError
        If a number is missing, not finite or outside 0 to 1.

    Examples
    --------
    >>> parse_yolo_line("0 0.5 0.5 0.2 0.4", "line 1", ["cucumber"]).box.round(2).tolist()
    [0.4, 0.3, 0.6, 0.7]
    """
    values = _finite(line.split())
    if len(values) < 5 or values[0] < 0 or values[0] % 1:
        raise ValueError("is neither box nor polygon")
    number, shares, confidence = int(values[0]), values[1:], 1.0
    count, numbers = kpt_shape or (0, 0)
    if count and len(values) != (expected := 5 + count * numbers):
        raise ValueError(f"has {len(values)} values, expected {expected} (box, {count} keypoints)")
    per_point = kpt_shape[1] if kpt_shape else _numbers_a_point(shares)
    if (len(shares) - 4) % (per_point or 2):
        shares, confidence = shares[:-1], float(shares[-1])
    keypoints, points = None, shares[4:].reshape(-1, per_point or 2)
    if per_point:
        shares = np.concatenate([shares[:4], points[:, :2].ravel()])
        seen = points[:, 2] if per_point == 3 else np.full(len(points), 2.0)
        if len(points) == _KEYPOINTS:
            visible = 1.0 if (seen % 1).any() else 2.0  # predictions have confidences
            keypoints = _keypoints(np.column_stack([points[:, :2], seen]).ravel(), visible)
    if (shares < -_SLACK).any() or (shares > 1 + _SLACK).any():
        raise ValueError("has numbers outside 0 to 1, which must be shares of width and height")
    is_box = per_point or len(shares) == 4
    half = shares[2:4] / 2
    return LabelledInstance(
        where=where,
        class_name=names[number].strip() if number < len(names) else str(number),
        confidence=confidence,
        box=np.concatenate([shares[:2] - half, shares[:2] + half]) if is_box else None,
        polygons=() if is_box else (polygon_points(shares),),
        keypoints=keypoints,
        normalised=True,
        entry={"kpt_shape": (len(points), 2)} if per_point == 2 else {},
    )


def _numbers_a_point(shares: Array) -> int:
    """Return 3 or 2 for a box and its keypoints with or without visibility, 0 for other labels."""
    box = shares[:4]
    for end in (len(shares), len(shares) - 1):  # a confidence may follow
        numbers = shares[4:end]
        if len(numbers) >= 6 and len(numbers) % 3 == 0:
            points = numbers.reshape(-1, 3)
            seen = points[points[:, 2] > 0, :2]
            is_five, is_stated = len(points) == _KEYPOINTS, np.isin(points[:, 2], (0, 1, 2)).all()
            if (is_five and is_stated) or ((is_five or is_stated) and _spans(box, seen)):
                return 3
        if len(numbers) >= 4 and len(numbers) % 2 == 0 and _spans(box, numbers.reshape(-1, 2)):
            return 2
    return 0


def _spans(box: Array, points: Array) -> bool:
    """Return whether points run through a box, given by centre and size, over most of it."""
    if not len(points) or not (box[2:] > 0).all():
        return False
    inside = (np.abs(points - box[:2]) <= _IN_BOX * box[2:]).all()
    path = np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
    along = np.linalg.norm(points[-1] - points[0]) >= _ALONG * path
    middle = np.abs((points.min(axis=0) + points.max(axis=0)) / 2 - box[:2]) / box[2:]
    centred = (middle <= _OFF_CENTRE).all()
    return bool(
        inside and along and centred and (np.ptp(points, axis=0) / box[2:]).max() >= _SPANS_BOX
    )


def _finite(values: Any) -> Array:
    numbers = np.array(values, np.float64)
    if numbers.ndim != 1 or not np.isfinite(numbers).all():
        raise ValueError("has a number that is not finite")
    return numbers


def _keypoints(values: Array, visible: float) -> Array:
    """Return five keypoints; COCO writes visibility as 0, 1 (hidden) or 2 (visible)."""
    if len(values) != 3 * _KEYPOINTS:
        raise ValueError(f"has {len(values)} keypoint numbers, not {3 * _KEYPOINTS}")
    points = values.reshape(_KEYPOINTS, 3).copy()
    points[:, 2] = np.clip(points[:, 2] / visible, 0.0, 1.0)
    return points


def is_rectangle(points: Array) -> bool:
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


def entry_or_error(
    where: str, source: object, read: Callable[..., _T], *arguments: Any
) -> _T | InstancesError:
    """Return the parsed entry, or its error."""
    try:
        return read(*arguments)
    except CucumberVisionError as error:
        fault = str(error.message)
    except KeyError as error:
        fault = f"key {error} is missing"
    except (AttributeError, TypeError, ValueError, OverflowError) as error:
        fault = str(error)
    return InstancesError(f"{where}: {fault}", source=source, remedy="correct it")


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
