"""The files that people and detectors write instances in: COCO JSON and YOLO txt, as records."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.errors import InstancesError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

__all__ = ["Picture", "Record", "parse_yolo_line", "read_coco", "read_yolo_classes"]

_KEYPOINTS = 5
_SLACK = 1e-6  # numbers written with few digits may lie this far outside 0 to 1


@dataclass(frozen=True, eq=False)
class Record:
    """One instance as a file writes it, before it meets its picture.

    Parameters
    ----------
    where : str
        Place in the file, for errors: 'annotation 7', 'line 3'.
    label : str
        Class name.
    score : float
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
    label: str
    score: float = 1.0
    box: NDArray[np.float64] | None = None
    polygons: tuple[NDArray[np.float64], ...] = ()
    rle: Mapping[str, Any] | None = None
    keypoints: NDArray[np.float64] | None = None
    normalised: bool = False


@dataclass(frozen=True, eq=False)
class Picture:
    """What a file says of one picture.

    Parameters
    ----------
    name : str
        File name, or '' where the file gives only a number.
    number : int, optional
        COCO's image id.
    size_px : tuple of int, optional
        Width and height, where the file gives them.
    records : list of Record or InstancesError
        Its instances, and what could not be read.
    """

    name: str
    number: int | None
    size_px: tuple[int, int] | None
    records: list[Record | InstancesError]


def read_coco(path: Path) -> list[Picture]:
    """Read COCO annotations (a dict of images and annotations) or results (a list).

    Raises
    ------
    InstancesError
        If the file is no JSON, or neither of the two.
    """
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InstancesError(
            f"is no JSON ({error})", source=path, remedy="write it again"
        ) from error
    annotated = isinstance(data, dict)
    items = data.get("annotations") if annotated else data
    if not isinstance(items, list):
        raise InstancesError("has no annotations", source=path, remedy="give COCO JSON")
    pictures = {}
    for image in data.get("images", []) if annotated else []:
        if not isinstance(image, dict) or "id" not in image:
            raise InstancesError("has an image without id", source=path, remedy="give COCO JSON")
        size = (image["width"], image["height"]) if {"width", "height"} <= set(image) else None
        name, number = str(image.get("file_name", "")), image["id"]
        pictures[str(number)] = Picture(name, _number(number), size, [])
    categories = data.get("categories", []) if annotated else []
    names = {c["id"]: str(c["name"]) for c in categories if {"id", "name"} <= set(c)}
    for i, item in enumerate(items):
        where = f"annotation {item.get('id', i) if isinstance(item, dict) else i}"
        key = _coco_key(item, path, where)
        if key not in pictures:
            name = str(item.get("file_name", ""))
            pictures[key] = Picture(name, _number(item.get("image_id")), None, [])
        try:
            record: Record | InstancesError = _coco_record(item, where, names, annotated)
        except (TypeError, ValueError, KeyError) as error:
            record = InstancesError(f"{where}: {error}", source=path, remedy="correct it")
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
) -> Record:
    if item.get("iscrowd"):
        raise ValueError("a crowd region is no single fruit")
    box = None
    if item.get("bbox"):
        x, y, w, h = _finite(item["bbox"])
        box = np.array([x, y, x + w, y + h])
    shape = item.get("segmentation") or []
    polygons = () if isinstance(shape, dict) else tuple(_polygon(_finite(p)) for p in shape)
    if box is None and not shape:
        raise ValueError("has neither box nor mask")
    keypoints = None
    if item.get("keypoints"):
        keypoints = _keypoints(_finite(item["keypoints"]), 2.0 if annotated else 1.0)
    category = item.get("category_id", 0)
    return Record(
        where=where,
        label=names.get(category, str(category)),
        score=float(_finite([item.get("score", 1.0)])[0]),
        box=box,
        polygons=polygons,
        rle=shape if isinstance(shape, dict) else None,
        keypoints=keypoints,
    )


def read_yolo_classes(folder: Path) -> list[str]:
    """Read the class names from `classes.txt` beside the labels; empty without one."""
    path = folder / "classes.txt"
    return path.read_text(encoding="utf-8").split("\n") if path.is_file() else []


def parse_yolo_line(line: str, where: str, names: list[str]) -> Record:
    """Read one line of a YOLO label file.

    Parameters
    ----------
    line : str
        'class cx cy w h', a polygon 'class x1 y1 x2 y2 x3 y3 ...', or a box with five keypoints
        'class cx cy w h x y v ...'; a confidence may stand at the end. Shares of the picture.
    where : str
        Place in the file, for errors.
    names : list of str
        Class names; the class's number stands in for a missing one.

    Returns
    -------
    Record

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
    number, rest = int(values[0]), values[1:]
    pose = 4 + 3 * _KEYPOINTS
    keypoints, score = None, 1.0
    polygons: tuple[NDArray[np.float64], ...] = ()
    if len(rest) in (pose, pose + 1) and np.isin(rest[6:pose:3], (0, 1, 2)).all():
        score = float(rest[pose]) if len(rest) > pose else 1.0
        keypoints = _keypoints(rest[4:pose], 2.0)
        shares = np.concatenate([rest[:4], keypoints[:, :2].ravel()])
        rest = rest[:4]
    else:
        if len(rest) % 2:
            rest, score = rest[:-1], float(rest[-1])
        shares = rest
    if (shares < -_SLACK).any() or (shares > 1 + _SLACK).any():
        raise ValueError("has numbers outside 0 to 1, which must be shares of width and height")
    box = None
    if len(rest) == 4:
        half = rest[2:] / 2
        box = np.concatenate([rest[:2] - half, rest[:2] + half])
    else:
        polygons = (_polygon(rest),)
    label = names[number].strip() if number < len(names) else str(number)
    return Record(where, label, score, box, polygons, None, keypoints, normalised=True)


def _finite(values: Any) -> NDArray[np.float64]:
    numbers = np.array(values, np.float64)
    if numbers.ndim != 1 or not np.isfinite(numbers).all():
        raise ValueError("has a number that is not finite")
    return numbers


def _polygon(values: NDArray[np.float64]) -> NDArray[np.float64]:
    if len(values) < 6 or len(values) % 2:
        raise ValueError("has a polygon of fewer than three points")
    return values.reshape(-1, 2)


def _keypoints(values: NDArray[np.float64], visible: float) -> NDArray[np.float64]:
    """Give five keypoints; COCO writes visibility as 0, 1 (hidden) or 2 (visible)."""
    if len(values) != 3 * _KEYPOINTS:
        raise ValueError(f"has {len(values)} keypoint numbers, not {3 * _KEYPOINTS}")
    points = values.reshape(_KEYPOINTS, 3).copy()
    points[:, 2] = np.clip(points[:, 2] / visible, 0.0, 1.0)
    return points
