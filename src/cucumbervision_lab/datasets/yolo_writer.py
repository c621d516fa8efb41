"""Write data sets for Ultralytics: pictures, label files by split and `data.yaml`."""

from __future__ import annotations

import json
import math
import zlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

from cucumbervision.capture.files import write_bytes
from cucumbervision.capture.pictures import read_color
from cucumbervision.errors import DataSetError
from cucumbervision_lab.datasets.labels import (
    SPLITS,
    DataSet,
    Label,
    LabelledPicture,
    flat_names,
    place_file,
    ticked,
    write_text,
)
from cucumbervision_lab.datasets.polygons import one_polygon
from cucumbervision_lab.datasets.yolo import PICTURES

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

TASKS = ("segment", "pose", "detect")

_JPEG_QUALITY = 95
_EDGE_SHARE = 0.06  # of the root of a mask's area: what is left around it when the rest is painted


@dataclass(frozen=True)
class WrittenYolo:
    """What `write_yolo` wrote.

    Parameters
    ----------
    data_yaml : Path
        The file that Ultralytics is given.
    pictures : mapping of str to int
        Their number in each split.
    labels : int
        Lines in all label files.
    painted : int
        Pictures in which what is to be ignored was painted over.
    filled_holes : int
        Masks with holes, which a polygon has not.
    """

    data_yaml: Path
    pictures: dict[str, int]
    labels: int
    painted: int
    filled_holes: int


def write_yolo(
    dataset: DataSet,
    out: Path,
    task: str = "segment",
    *,
    splits: Sequence[str] = SPLITS,
    link: bool = True,
    paint_ignored: Sequence[str] = ("train",),
    progress: Callable[[int], None] | None = None,
) -> WrittenYolo:
    """Write a set as Ultralytics reads it: `images/SPLIT`, `labels/SPLIT`, `data.yaml`.

    Parameters
    ----------
    dataset : DataSet
        Every picture in a split.
    out : Path
        Made if it does not exist.
    task : str
        'segment' (one polygon a fruit, parts joined, holes filled), 'pose' (five keypoints with
        visibility; a fruit without any has five of visibility 0) or 'detect'.
    splits : sequence of str
        Which splits to write: a test set of boxes alone has no place among masks.
    link : bool
        Pictures become second names of the same files where the disk can; else copies.
    paint_ignored : sequence of str
        Splits in which regions to ignore are painted over, since Ultralytics has no 'ignore':
        with another picture of the split that shows no fruit, or with grey noise where there is
        none. In others the pictures stay as they are, without labels there, and the regions'
        outlines are written to `ignored/SPLIT`, for our own training.
    progress : callable, optional
        Called with 1 after each picture.

    Returns
    -------
    WrittenYolo

    Raises
    ------
    DataSetError
        If a picture is in no split, a label lacks what the task needs, a picture is missing, or
        the folder cannot be written.

    Notes
    -----
    Format: Ultralytics, "Instance Segmentation / Pose Estimation Datasets Overview".
    `pictures.json` beside `data.yaml` keeps scene, source and licence, which the format has not.
    """
    dataset = _chosen(dataset, splits)
    _require(dataset, task)
    names = flat_names(p.file for p in dataset.pictures)
    counts = dict.fromkeys(SPLITS, 0)
    lines = painted = holes = 0
    origins = {}
    grounds = {
        split: [dataset.path(p) for p in dataset.in_split(split) if not p.labels]
        for split in paint_ignored
    }
    for picture in ticked(dataset.pictures, progress):
        name = names[picture.file]
        target = out / "images" / picture.split / name
        ignored = picture.split in paint_ignored and any(x.ignore for x in picture.labels)
        if ignored:
            _paint(dataset, picture, target, grounds[picture.split])
        else:
            place_file(dataset.path(picture), target, link=link)
        rows = [_row(x, picture, task) for x in picture.labels if not x.ignore]
        label_file = out / "labels" / picture.split / f"{Path(name).stem}.txt"
        write_text(label_file, "".join(f"{row}\n" for row, _ in rows))
        regions = [] if ignored else [_outline(x, picture) for x in picture.labels if x.ignore]
        if regions:
            ignored_file = out / "ignored" / picture.split / label_file.name
            write_text(ignored_file, "".join(f"{row}\n" for row in regions))
        lines, holes = lines + len(rows), holes + sum(hole for _, hole in rows)
        counts[picture.split] += 1
        painted += ignored
        origins[f"images/{picture.split}/{name}"] = {
            "scene": picture.scene,
            "source": picture.source,
            "licence": picture.licence,
        }
    # Ultralytics trusts its cache by the files' sizes, which may be equal by chance.
    for cache in (out / "labels").glob("*.cache"):
        cache.unlink()
    write_text(out / PICTURES, json.dumps(origins, ensure_ascii=False, indent=0) + "\n")
    write_text(out / "data.yaml", _data_yaml(dataset, task, counts))
    return WrittenYolo(out / "data.yaml", counts, lines, painted, holes)


def _chosen(dataset: DataSet, splits: Sequence[str]) -> DataSet:
    unknown = [split for split in splits if split not in SPLITS]
    if unknown:
        raise DataSetError(
            f"no split is called {unknown[0]!r}", remedy=f"choose of {', '.join(SPLITS)}"
        )
    # Pictures without a split stay, to be refused.
    chosen = {*splits, *({p.split for p in dataset.pictures} - set(SPLITS))}
    return replace(dataset, pictures=tuple(p for p in dataset.pictures if p.split in chosen))


def _require(dataset: DataSet, task: str) -> None:
    if task not in TASKS:
        raise DataSetError(
            f"no task is called {task!r}", remedy=f"choose one of {', '.join(TASKS)}"
        )
    without = [p.file for p in dataset.pictures if p.split not in SPLITS]
    if without:
        raise DataSetError(
            f"{len(without)} pictures are in no split, first {without[0]}",
            source=dataset.folder,
            remedy="split the set first: cucumbervision data split",
        )
    bare = [
        p.file
        for p in dataset.pictures
        for label in p.labels
        if task == "segment" and label.mask_code is None and not label.ignore
    ]
    if bare:
        raise DataSetError(
            f"{len(bare)} labels have a box but no mask, first in {bare[0]}",
            source=dataset.folder,
            remedy="draw masks first (cucumbervision data pseudo) or leave that split out",
        )


def _outline(label: Label, picture: LabelledPicture) -> str:
    """Return the outline of a region: its mask's, or its box."""
    size = np.array([picture.width, picture.height], np.float64)
    mask = label.mask
    polygon = None if mask is None else one_polygon(mask)
    if polygon is None:
        (x1, y1, x2, y2) = label.box + 0.5
        polygon = np.array([[x1, y1], [x2, y1], [x2, y2], [x1, y2]])
    return _numbers(np.clip(polygon / size, 0, 1))


def _row(label: Label, picture: LabelledPicture, task: str) -> tuple[str, bool]:
    """Return a label's line, and whether a hole was filled."""
    size = np.array([picture.width, picture.height], np.float64)
    mask = label.mask if task == "segment" else None
    if mask is not None:
        polygon = one_polygon(mask)
        if polygon is None:
            raise DataSetError(
                "a label's mask is empty", source=picture.file, remedy="remove the label"
            )
        return f"{label.category} {_numbers(polygon / size)}", _has_hole(mask)
    corners = np.clip((label.box.reshape(2, 2) + 0.5) / size, 0, 1)
    box = np.concatenate([corners.mean(axis=0), corners[1] - corners[0]])
    row = f"{label.category} {_numbers(box)}"
    if task == "pose":
        points = np.zeros((5, 3)) if label.keypoints is None else label.keypoints
        row += "".join(_keypoint(point, size) for point in points)
    return row, False


def _keypoint(point: NDArray[np.float64], size: NDArray[np.float64]) -> str:
    share = (point[:2] + 0.5) / size
    if point[2] == 0 or (share < 0).any() or (share > 1).any():
        # Ultralytics refuses a whole picture for one point beyond its border.
        return " 0 0 0"
    return f" {_numbers(share)} {int(point[2])}"


def _has_hole(mask: NDArray[np.bool_]) -> bool:
    import cv2

    _, levels = cv2.findContours(mask.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
    return bool((levels[0, :, 3] >= 0).any())


def _numbers(values: NDArray[np.float64]) -> str:
    return " ".join(f"{v:.6f}" for v in np.ravel(values))


def _ignore_region(picture: LabelledPicture) -> NDArray[np.bool_]:
    """Return what is to be ignored in a picture: masks, or boxes without one, less every fruit.

    Returns
    -------
    ndarray of bool, shape (height, width)

    Examples
    --------
    >>> crate = Label(np.array([0.5, 0.5, 4.5, 2.5]), ignore=True)
    >>> fruit = Label(np.array([2.5, 0.5, 4.5, 2.5]))
    >>> _ignore_region(LabelledPicture("a.png", 6, 4, (crate, fruit))).astype(int).tolist()
    [[0, 0, 0, 0, 0, 0], [0, 1, 1, 0, 0, 0], [0, 1, 1, 0, 0, 0], [0, 0, 0, 0, 0, 0]]
    """
    region = np.zeros((picture.height, picture.width), bool)
    for wanted in (True, False):
        for label in picture.labels:
            if label.ignore is wanted:
                region[_pixels_of(label, region.shape, edge=not wanted)] = wanted
    return region


def _pixels_of(label: Label, shape: tuple[int, ...], *, edge: bool) -> NDArray[np.bool_]:
    """Return a label's mask, or its box; with its edge, which tells where a fruit ends."""
    import cv2

    mask = label.mask
    if mask is None:
        x1, y1, x2, y2 = np.rint(np.maximum(label.box + 0.5, 0)).astype(int)
        mask = np.zeros(shape, bool)
        mask[y1:y2, x1:x2] = True
        return mask
    if not edge:
        return mask
    margin = int(_EDGE_SHARE * math.sqrt(np.count_nonzero(mask)))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * margin + 1, 2 * margin + 1))
    return np.asarray(cv2.dilate(mask.astype(np.uint8), kernel), bool)


def _paint(
    dataset: DataSet, picture: LabelledPicture, target: Path, grounds: Sequence[Path]
) -> None:
    """Write a picture with something else where it is to be ignored."""
    import cv2

    color = read_color(dataset.path(picture))
    region = _ignore_region(picture)
    # The same at each writing, so that a set is reproducible.
    rng = np.random.default_rng(zlib.crc32(picture.file.encode()))
    if grounds:
        other = read_color(grounds[int(rng.integers(len(grounds)))])
        cover = cv2.resize(other, region.shape[::-1], interpolation=cv2.INTER_AREA)
    else:
        cover = rng.integers(96, 160, (*region.shape, 1), np.uint8)
    color = np.where(region[..., None], cover, color)
    suffix = target.suffix.lower()
    quality = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY] if suffix in {".jpg", ".jpeg"} else []
    _, data = cv2.imencode(suffix, cv2.cvtColor(color, cv2.COLOR_RGB2BGR), quality)
    target.parent.mkdir(parents=True, exist_ok=True)
    # A link must be cut first: writing through it would spoil the source.
    target.unlink(missing_ok=True)
    write_bytes(target, data.tobytes())


def _data_yaml(dataset: DataSet, task: str, counts: dict[str, int]) -> str:
    data: dict[str, Any] = {split: f"images/{split}" for split in SPLITS if counts[split]}
    data["names"] = dict(enumerate(dataset.categories))
    if task == "pose":
        data["kpt_shape"] = [len(dataset.keypoint_names), 3]
        data["flip_idx"] = list(dataset.flip_index)
        data["kpt_names"] = {k: list(dataset.keypoint_names) for k in data["names"]}
    return yaml.safe_dump(data, default_flow_style=None, sort_keys=False, allow_unicode=True)
