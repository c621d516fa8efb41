"""Read and write data sets in Ultralytics' YOLO format."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from cucumbervision.capture.pictures import read_color, write_jpeg, write_png
from cucumbervision.errors import (
    CucumberVisionError,
    DataSetError,
    InstancesError,
    wrap_reader_errors,
)
from cucumbervision.files import read_bytes, read_json, read_text
from cucumbervision.fruit.instance import KEYPOINT_NAMES
from cucumbervision.fruit.label_files import read_yolo_file
from cucumbervision_lab.arrays import Array, Progress
from cucumbervision_lab.data.labels import (
    SPLIT_FOLDERS,
    SPLITS,
    DataSet,
    Label,
    LabelledPicture,
    flat_names,
    labels_of,
    list_pictures,
    one_polygon,
    picture_size,
    place_file,
    ticked,
    write_text,
)

PICTURES = "pictures.json"
"""File next to `data.yaml` with scene, source and licence, for which YOLO has no fields."""

_KEYPOINTS = 5
_GREY = 114


def read_yolo(path: Path, names: Sequence[str] = ()) -> DataSet:
    """Read a YOLO data set with boxes, polygons or keypoints.

    Parameters
    ----------
    path : Path
        A `data.yaml`, its folder, or a folder with images/ and labels/.
    names : sequence of str
        Class names, if there is no `data.yaml`.

    Returns
    -------
    DataSet
        The data set, with polygons converted to masks. Errors of invalid lines and pictures are
        listed in `refused`.

    Raises
    ------
    DataSetError
        If there are no pictures or no class names.

    Examples
    --------
    >>> import tempfile
    >>> from cucumbervision.capture.pictures import write_png
    >>> with tempfile.TemporaryDirectory() as tmp:
    ...     for kind in ("images", "labels"):
    ...         Path(tmp, kind).mkdir()
    ...     write_png(Path(tmp, "images/a.png"), np.zeros((60, 80, 3), np.uint8))
    ...     _ = Path(tmp, "labels/a.txt").write_text("0 0.5 0.5 0.5 0.5")
    ...     read_yolo(Path(tmp), ["cucumber"]).pictures[0].labels[0].box.tolist()
    [19.5, 14.5, 59.5, 44.5]
    """
    file = path if path.is_file() else path / "data.yaml"
    folder = file.parent.resolve()
    data = _data_of(file) if file.is_file() else {}
    with wrap_reader_errors(file, DataSetError, "correct it"):
        categories = tuple(names) or _class_names(data.get("names"))
        files = _listed(data, folder) or _pictures_in_images(folder)
        points, numbers = data.get("kpt_shape") or (0, 0)
    if not categories:
        raise DataSetError("no class names", source=path, remedy="add data.yaml or give --names")
    if not files:
        raise DataSetError(
            "contains no pictures in images/",
            source=path,
            remedy="give the folder of a YOLO data set",
        )
    if (points, numbers) not in ((0, 0), (_KEYPOINTS, 2), (_KEYPOINTS, 3)):
        raise DataSetError(
            f"kpt_shape is {[points, numbers]}, expected [5, 3] or [5, 2]",
            source=file,
            remedy="label five keypoints from blossom end to stem end",
        )
    origins = _origins(folder)
    pictures: list[LabelledPicture] = []
    refused: list[CucumberVisionError] = []
    for picture, split in files:
        name, labels = picture.relative_to(folder).as_posix(), _label_file(picture)
        try:
            width, height = picture_size(picture)
        except CucumberVisionError as error:
            refused.append(error)
            continue
        found: tuple[Label, ...] = ()
        try:
            if not labels.exists():
                raise InstancesError(
                    "the label file is missing",
                    source=labels,
                    remedy="create an empty file if the picture shows no fruit",
                )
            image = read_yolo_file(labels, categories, (points, numbers))
            found, bad = labels_of(image, width, height, categories, labels)
            refused += bad
        except InstancesError as error:
            refused.append(error)
        origin = origins.get(name, {})
        pictures.append(LabelledPicture(name, width, height, found, split=split, **origin))
    return DataSet(folder, tuple(pictures), categories, refused=tuple(refused))


def _data_of(path: Path) -> dict[str, Any]:
    """Read a `data.yaml`."""
    with wrap_reader_errors(path, DataSetError, "correct it"):
        text = read_bytes(path)
        # Nested aliases can expand to exponential size.
        if any(isinstance(token, yaml.AliasToken) for token in yaml.scan(text)):
            raise ValueError("it has aliases")
        data = yaml.safe_load(text)
    if not isinstance(data, dict):
        raise DataSetError(
            "does not describe a data set", source=path, remedy="add train, val and names"
        )
    return data


def _class_names(names: Any) -> tuple[str, ...]:
    """Return the class names of a `data.yaml`, a list or a mapping from index to name."""
    if isinstance(names, dict):
        if sorted(names) != list(range(len(names))):
            raise ValueError("its class indices are not consecutive from 0")
        names = [names[k] for k in range(len(names))]
    return tuple(map(str, names or ()))


def _listed(data: Mapping[str, Any], folder: Path) -> list[tuple[Path, str]]:
    """Return the pictures listed in `data.yaml` as folders, lists or text files."""
    base = folder / str(data.get("path") or "")
    split_of: dict[Path, str] = {}
    for key, split in SPLIT_FOLDERS.items():
        entries = data.get(key)
        for entry in entries if isinstance(entries, list) else [entries] if entries else []:
            place = _resolve(str(entry), base, folder)
            if place.suffix == ".txt" and place.is_file():
                lines = read_text(place, DataSetError).split("\n")
                files = [_resolve(x.strip(), place.parent, folder) for x in lines if x.strip()]
            else:
                files = list_pictures(place)
            for file in files:
                if file.is_relative_to(folder):
                    split_of.setdefault(file, split)
    return sorted(split_of.items())


def _resolve(entry: str, base: Path, folder: Path) -> Path:
    # Roboflow writes ../train/images for a folder next to data.yaml.
    inner = entry.replace("../", "")
    places = [base / entry, base / inner, folder / inner]
    for place in places:
        # Resolve only the parent, because the picture itself may be a symbolic link.
        clean = place.parent.resolve() / place.name
        if clean.exists() and clean.is_relative_to(folder):
            return clean
    return places[0]


def _pictures_in_images(folder: Path) -> list[tuple[Path, str]]:
    files = []
    for file in list_pictures(folder):
        parts = file.relative_to(folder).parts[:-1]
        if "images" in parts:
            files.append((file, next((SPLIT_FOLDERS[p] for p in parts if p in SPLIT_FOLDERS), "")))
    return files


def _label_file(picture: Path) -> Path:
    """Return the label file of a picture by Ultralytics' convention.

    Examples
    --------
    >>> _label_file(Path("set/images/train/a.jpg")).as_posix()
    'set/labels/train/a.txt'
    """
    head, _, tail = picture.as_posix().rpartition("/images/")
    return (Path(head) / "labels" / tail if head else picture).with_suffix(".txt")


def _origins(folder: Path) -> dict[str, dict[str, Any]]:
    file = folder / PICTURES
    data = read_json(file) if file.is_file() else {}
    if not isinstance(data, dict) or not all(isinstance(v, dict) for v in data.values()):
        raise DataSetError("is not a JSON object of pictures", source=file, remedy="delete it")
    keys = ("scene", "source", "licence")
    return {name: {k: str(v[k]) for k in keys if v.get(k)} for name, v in data.items()}


TASKS = ("segment", "pose", "detect")


def write_yolo(
    dataset: DataSet,
    out: Path,
    task: str = "segment",
    *,
    splits: Sequence[str] = SPLITS,
    progress: Progress | None = None,
) -> tuple[dict[str, int], int]:
    """Write a data set in YOLO format: `images/SPLIT`, `labels/SPLIT` and `data.yaml`.

    Parameters
    ----------
    dataset : DataSet
        Data set in which every picture has a split.
    out : Path
        Output folder; created if missing.
    task : str
        'segment' (one polygon per fruit, parts joined, holes filled), 'pose' (five keypoints with
        visibility, 0 for a fruit without keypoints) or 'detect'.
    splits : sequence of str
        Splits to write; omit a split without masks when writing for 'segment'.
    progress : callable, optional
        Called with 1 after each picture.

    Returns
    -------
    pictures : dict of str to int
        Number of pictures in each split.
    labels : int
        Number of lines in all label files.

    Raises
    ------
    DataSetError
        If a picture has no split, a label lacks a mask for 'segment', a picture is missing, or the
        folder is not writable.

    Notes
    -----
    Format: Ultralytics, "Instance Segmentation / Pose Estimation Datasets Overview". The format has
    no ignore regions: they are painted grey. `pictures.json` next to `data.yaml` stores scene,
    source and licence.
    """
    dataset = _chosen(dataset, splits)
    _require(dataset, task)
    names = flat_names(p.file for p in dataset.pictures)
    counts = dict.fromkeys(SPLITS, 0)
    lines = 0
    origins = {}
    for picture in ticked(dataset.pictures, progress):
        name = names[picture.file]
        _place_picture(dataset, picture, out / "images" / picture.split / name)
        rows = [_row(x, picture, task) for x in picture.labels if not x.ignore]
        label_file = out / "labels" / picture.split / f"{Path(name).stem}.txt"
        write_text(label_file, "".join(f"{row}\n" for row in rows))
        lines += len(rows)
        counts[picture.split] += 1
        origins[f"images/{picture.split}/{name}"] = {
            "scene": picture.scene,
            "source": picture.source,
            "licence": picture.licence,
        }
    # Ultralytics validates its cache by file sizes only, which may be equal by chance.
    for cache in (out / "labels").glob("*.cache"):
        cache.unlink()
    write_text(out / PICTURES, json.dumps(origins, ensure_ascii=False, indent=0) + "\n")
    write_text(out / "data.yaml", _data_yaml(dataset, task, counts))
    return counts, lines


def _chosen(dataset: DataSet, splits: Sequence[str]) -> DataSet:
    unknown = [split for split in splits if split not in SPLITS]
    if unknown:
        raise DataSetError(f"unknown split {unknown[0]!r}", remedy=f"use {', '.join(SPLITS)}")
    # Keep pictures without a split, so that `_require` reports them.
    chosen = {*splits, *({p.split for p in dataset.pictures} - set(SPLITS))}
    return replace(dataset, pictures=tuple(p for p in dataset.pictures if p.split in chosen))


def _require(dataset: DataSet, task: str) -> None:
    if task not in TASKS:
        raise DataSetError(f"unknown task {task!r}", remedy=f"use one of {', '.join(TASKS)}")
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
            remedy="add masks first (cucumbervision data pseudo) or omit that split",
        )


def _place_picture(dataset: DataSet, picture: LabelledPicture, target: Path) -> None:
    """Link a picture, or write it with its ignore regions in the grey of Ultralytics' padding."""
    if not any(label.ignore for label in picture.labels):
        place_file(dataset.path(picture), target)
        return
    painted = np.zeros((picture.height, picture.width), bool)
    for ignored in (True, False):
        for label in picture.labels:
            if label.ignore == ignored:
                mask = label.mask
                x1, y1, x2, y2 = np.rint(label.box + 0.5).astype(int).clip(0)
                painted[np.s_[y1:y2, x1:x2] if mask is None else mask] = ignored
    color = read_color(dataset.path(picture)).copy()
    color[painted] = _GREY
    target.parent.mkdir(parents=True, exist_ok=True)
    target.unlink(missing_ok=True)  # may be a link to the original
    if target.suffix.lower() in (".jpg", ".jpeg"):
        write_jpeg(target, color)
    else:
        write_png(target, color)


def _row(label: Label, picture: LabelledPicture, task: str) -> str:
    """Return the line of a label."""
    size = np.array([picture.width, picture.height], np.float64)
    mask = label.mask if task == "segment" else None
    if mask is not None:
        polygon = one_polygon(mask)
        if polygon is None:
            raise DataSetError(
                "a label's mask is empty", source=picture.file, remedy="remove the label"
            )
        return f"{label.category} {_numbers(polygon / size)}"
    corners = np.clip((label.box.reshape(2, 2) + 0.5) / size, 0, 1)
    box = np.concatenate([corners.mean(axis=0), corners[1] - corners[0]])
    row = f"{label.category} {_numbers(box)}"
    if task == "pose":
        points = np.zeros((5, 3)) if label.keypoints is None else label.keypoints
        row += "".join(_keypoint(point, size) for point in points)
    return row


def _keypoint(point: Array, size: Array) -> str:
    share = (point[:2] + 0.5) / size
    if point[2] == 0 or (share < 0).any() or (share > 1).any():
        # Ultralytics rejects the whole picture if one keypoint lies outside.
        return " 0 0 0"
    return f" {_numbers(share)} {int(point[2])}"


def _numbers(values: Array) -> str:
    return " ".join(f"{v:.6f}" for v in np.ravel(values))


def _data_yaml(dataset: DataSet, task: str, counts: dict[str, int]) -> str:
    data: dict[str, Any] = {split: f"images/{split}" for split in SPLITS if counts[split]}
    data["names"] = dict(enumerate(dataset.categories))
    if task == "pose":
        data["kpt_shape"] = [_KEYPOINTS, 3]
        # No keypoint is a left or right one, so mirroring keeps the order.
        data["flip_idx"] = list(range(_KEYPOINTS))
        data["kpt_names"] = {k: list(KEYPOINT_NAMES) for k in data["names"]}
    return yaml.safe_dump(data, default_flow_style=None, sort_keys=False, allow_unicode=True)
