"""Read labels as COCO and YOLO files hold them, each entry or its error."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from cucumbervision.errors import InstancesError, wrap_reader_errors
from cucumbervision.files import read_json, read_text
from cucumbervision.instances.mask_codes import polygon_points

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.typing import NDArray


_T = TypeVar("_T")
_KEYPOINTS = 5
_SLACK = 1e-6  # tolerance outside 0 to 1 for rounded numbers


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
    """

    where: str
    class_name: str
    confidence: float = 1.0
    box: NDArray[np.float64] | None = None
    polygons: tuple[NDArray[np.float64], ...] = ()
    rle: Mapping[str, Any] | None = None
    keypoints: NDArray[np.float64] | None = None
    normalised: bool = False


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
    """

    name: str
    number: int | None
    size_px: tuple[int, int] | None
    records: list[LabelledInstance | InstancesError]


def read_labels(path: Path) -> list[LabelledImage]:
    """Read COCO JSON, a YOLO txt file, or a folder of YOLO txt files named as their pictures.

    Parameters
    ----------
    path : Path
        As for `instance_files.read_instances`.

    Raises
    ------
    InstancesError
        If there is no such file, or it is none of these.
    """
    if path.is_dir():
        return _read_yolo_folder(path)
    if not path.is_file():
        raise InstancesError("there is no such file", source=path, remedy="check the path")
    if path.suffix.lower() == ".json":
        return read_coco(path)
    if path.suffix.lower() == ".txt":
        return [_read_yolo_file(path, _read_yolo_classes(path.parent))]
    raise InstancesError("unknown kind of file", source=path, remedy="give COCO JSON or YOLO txt")


def read_coco(path: Path) -> list[LabelledImage]:
    """Read COCO annotations (a dict of images and annotations) or results (a list).

    Raises
    ------
    InstancesError
        If the file is not JSON, or neither of the two.
    """
    data = read_json(path, InstancesError)
    with wrap_reader_errors(path, InstancesError, "give COCO JSON"):
        return _coco_pictures(data, path)


def _coco_pictures(data: Any, path: Path) -> list[LabelledImage]:
    annotated = isinstance(data, dict)
    items = data.get("annotations") if annotated else data
    if not isinstance(items, list):
        raise InstancesError("has no annotations", source=path, remedy="give COCO JSON")
    pictures = {}
    for image in data.get("images", []) if annotated else []:
        if not isinstance(image, dict) or "id" not in image:
            raise InstancesError("has an image without id", source=path, remedy="give COCO JSON")
        size = None
        if {"width", "height"} <= set(image):  # some tools write them as text
            size = int(float(image["width"])), int(float(image["height"]))
        name, number = str(image.get("file_name", "")), image["id"]
        pictures[str(number)] = LabelledImage(name, _number(number), size, [])
    categories = data.get("categories", []) if annotated else []
    names = {c["id"]: str(c["name"]) for c in categories if {"id", "name"} <= set(c)}
    for i, item in enumerate(items):
        where = f"annotation {item.get('id', i) if isinstance(item, dict) else i}"
        key = _coco_key(item, path, where)
        if key not in pictures:
            name = str(item.get("file_name", ""))
            pictures[key] = LabelledImage(name, _number(item.get("image_id")), None, [])
        record = entry_or_error(where, path, _coco_record, item, where, names, annotated)
        pictures[key].records.append(record)
    return list(pictures.values())


def _coco_key(item: Any, path: Path, where: str) -> str:
    if not isinstance(item, dict) or not {"image_id", "file_name"} & set(item):
        raise InstancesError(f"{where} names no picture", source=path, remedy="give COCO JSON")
    return str(item.get("image_id", item.get("file_name")))


def _number(value: Any) -> int | None:
    return int(value) if isinstance(value, int) or str(value).isdecimal() else None


def _coco_record(
    item: Mapping[str, Any], where: str, names: Mapping[Any, str], annotated: bool
) -> LabelledInstance:
    if item.get("iscrowd"):
        raise ValueError("a crowd region is not a single fruit")
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
        keypoints = _keypoints(_finite(item["keypoints"]), 2.0 if annotated else 1.0)
    category = item.get("category_id", 0)
    return LabelledInstance(
        where=where,
        class_name=names.get(category, str(category)),
        confidence=float(_finite([item.get("score", 1.0)])[0]),
        box=box,
        polygons=polygons,
        rle=shape if isinstance(shape, dict) else None,
        keypoints=keypoints,
    )


def _read_yolo_classes(folder: Path) -> list[str]:
    """Read the class names from `classes.txt` beside the labels; empty without one."""
    path = folder / "classes.txt"
    return read_text(path, InstancesError).split("\n") if path.is_file() else []


def parse_yolo_line(line: str, where: str, names: list[str]) -> LabelledInstance:
    """Read one line of a YOLO label file.

    Parameters
    ----------
    line : str
        'class cx cy w h', a polygon 'class x1 y1 x2 y2 x3 y3 ...', or a box with five keypoints
        'class cx cy w h x y v ...'; a confidence may follow. Coordinates are shares of the picture.
    where : str
        Place in the file, for errors.
    names : list of str
        Class names; the class number replaces a missing one.

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
    number, coordinates = int(values[0]), values[1:]
    pose = 4 + 3 * _KEYPOINTS
    keypoints, confidence = None, 1.0
    polygons: tuple[NDArray[np.float64], ...] = ()
    if len(coordinates) in (pose, pose + 1) and np.isin(coordinates[6:pose:3], (0, 1, 2)).all():
        confidence = float(coordinates[pose]) if len(coordinates) > pose else 1.0
        keypoints = _keypoints(coordinates[4:pose], 2.0)
        shares = np.concatenate([coordinates[:4], keypoints[:, :2].ravel()])
        coordinates = coordinates[:4]
    else:
        if len(coordinates) % 2:
            coordinates, confidence = coordinates[:-1], float(coordinates[-1])
        shares = coordinates
    if (shares < -_SLACK).any() or (shares > 1 + _SLACK).any():
        raise ValueError("has numbers outside 0 to 1, which must be shares of width and height")
    box = None
    if len(coordinates) == 4:
        half = coordinates[2:] / 2
        box = np.concatenate([coordinates[:2] - half, coordinates[:2] + half])
    else:
        polygons = (polygon_points(coordinates),)
    class_name = names[number].strip() if number < len(names) else str(number)
    return LabelledInstance(
        where=where,
        class_name=class_name,
        confidence=confidence,
        box=box,
        polygons=polygons,
        rle=None,
        keypoints=keypoints,
        normalised=True,
    )


def _finite(values: Any) -> NDArray[np.float64]:
    numbers = np.array(values, np.float64)
    if numbers.ndim != 1 or not np.isfinite(numbers).all():
        raise ValueError("has a number that is not finite")
    return numbers


def _keypoints(values: NDArray[np.float64], visible: float) -> NDArray[np.float64]:
    """Return five keypoints; COCO writes visibility as 0, 1 (hidden) or 2 (visible)."""
    if len(values) != 3 * _KEYPOINTS:
        raise ValueError(f"has {len(values)} keypoint numbers, not {3 * _KEYPOINTS}")
    points = values.reshape(_KEYPOINTS, 3).copy()
    points[:, 2] = np.clip(points[:, 2] / visible, 0.0, 1.0)
    return points


def _read_yolo_folder(folder: Path) -> list[LabelledImage]:
    for place in (folder, folder / "labels"):
        files = sorted(f for f in place.glob("*.txt") if f.name != "classes.txt")
        if files:
            names = _read_yolo_classes(place) or _read_yolo_classes(folder)
            return [_read_yolo_file(file, names) for file in files]
    raise InstancesError("holds no label files", source=folder, remedy="give YOLO txt files")


def _read_yolo_file(path: Path, names: list[str]) -> LabelledImage:
    lines = read_text(path, InstancesError).split("\n")
    records: list[LabelledInstance | InstancesError] = []
    for i, line in enumerate(lines, 1):
        if not line.strip():
            continue
        where = f"{path.name}, line {i}"
        records.append(entry_or_error(f"line {i}", path, parse_yolo_line, line, where, names))
    return LabelledImage(path.name, None, None, records)


def entry_or_error(
    where: str, source: object, read: Callable[..., _T], *arguments: Any
) -> _T | InstancesError:
    """Return the parsed entry, or its error."""
    try:
        return read(*arguments)
    except (TypeError, ValueError, KeyError, OverflowError) as error:
        return InstancesError(f"{where}: {error}", source=source, remedy="correct it")
