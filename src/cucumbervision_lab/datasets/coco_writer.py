"""Write a set as COCO and more: the form that `coco` reads."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.capture.camera_file import CameraModel
from cucumbervision.errors import DataSetError
from cucumbervision.perception.mask_codes import Rle
from cucumbervision_lab.datasets.coco import ANNOTATIONS
from cucumbervision_lab.datasets.labels import (
    DataSet,
    Label,
    LabelledPicture,
    flat_names,
    place_file,
    ticked,
    write_text,
)

if TYPE_CHECKING:
    from collections.abc import Callable

_DIGITS = 3  # of pixels: a hundredth of what a label is exact to


def write_coco(
    dataset: DataSet,
    folder: Path,
    *,
    link: bool = True,
    progress: Callable[[int], None] | None = None,
) -> DataSet:
    """Write a set in the hub form: `images/`, `depth/` and `annotations.json`.

    Parameters
    ----------
    dataset : DataSet
        What to write. In its own folder only `annotations.json` is written anew.
    folder : Path
        Made if it does not exist.
    link : bool
        Pictures become second names of the same files where the disk can; else copies.
    progress : callable, optional
        Called with 1 after each picture.

    Returns
    -------
    DataSet
        The set as it lies in `folder`.

    Raises
    ------
    DataSetError
        If a picture is missing or the folder cannot be written.
    """
    pictures = dataset.pictures
    if folder.resolve() != dataset.folder.resolve():
        pictures = _place_all(dataset, folder, link, progress)
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    for number, picture in enumerate(pictures, 1):
        fragment = _fragment(picture)
        images.append({"id": number, **fragment["image"]})
        for item in fragment["annotations"]:
            annotations.append({"id": len(annotations) + 1, "image_id": number, **item})
    data = {
        "info": {"description": "CucumberVision data set", "version": "1"},
        "categories": _categories(dataset),
        "images": images,
        "annotations": annotations,
    }
    write_text(folder / ANNOTATIONS, _json(data))
    return replace(dataset, folder=folder, pictures=tuple(pictures), refused=())


def write_fragment(picture: LabelledPicture, file: Path) -> Path:
    """Write one picture's labels as a JSON file of its own.

    For a generator that works in parallel and may be interrupted: one file a frame, written
    whole or not at all, and `collect_fragments` at the end.

    Parameters
    ----------
    picture : LabelledPicture
        Its picture file should be written before.
    file : Path
        Any name ending in .json, say `set/fragments/000001.json`.

    Returns
    -------
    Path
        `file`.

    Raises
    ------
    DataSetError
        If it cannot be written.
    """
    write_text(file, _json(_fragment(picture)))
    return file


def _place_all(
    dataset: DataSet, folder: Path, link: bool, progress: Callable[[int], None] | None
) -> tuple[LabelledPicture, ...]:
    placed = []
    names = flat_names(p.file for p in dataset.pictures)
    for picture in ticked(dataset.pictures, progress):
        name = names[picture.file]
        place_file(dataset.path(picture), folder / "images" / name, link=link)
        depth = picture.depth_file
        if depth is not None:
            target = PurePosixPath("depth", PurePosixPath(name).stem + PurePosixPath(depth).suffix)
            place_file(dataset.folder / depth, folder / target, link=link)
            depth = str(target)
        placed.append(replace(picture, file=f"images/{name}", depth_file=depth))
    return tuple(placed)


def _categories(dataset: DataSet) -> list[dict[str, Any]]:
    return [
        {
            "id": k + 1,
            "name": name,
            "supercategory": "fruit",
            "keypoints": list(dataset.keypoint_names),
            "skeleton": [[a + 1, b + 1] for a, b in dataset.skeleton],
        }
        for k, name in enumerate(dataset.categories)
    ]


def _fragment(picture: LabelledPicture) -> dict[str, Any]:
    image: dict[str, Any] = {
        "file_name": picture.file,
        "width": picture.width,
        "height": picture.height,
        "scene": picture.scene,
        "split": picture.split,
        "source": picture.source,
        "licence": picture.licence,
    }
    if picture.depth_file is not None:
        image |= {"depth_file": picture.depth_file, "depth_unit_m": picture.depth_unit_m}
    if picture.camera is not None:
        image["camera"] = CameraModel.of(picture.camera).model_dump(mode="json")
    if picture.extras:
        image["extras"] = dict(picture.extras)
    return {"image": image, "annotations": [_annotation(label) for label in picture.labels]}


def _annotation(label: Label) -> dict[str, Any]:
    x1, y1, x2, y2 = (float(v) for v in label.box)
    size = x2 - x1, y2 - y1
    area = size[0] * size[1] if label.mask_code is None else label.mask_code.area_px
    item: dict[str, Any] = {
        "category_id": label.category + 1,
        "bbox": [round(v, _DIGITS) for v in (x1 + 0.5, y1 + 0.5, *size)],
        "area": round(area, _DIGITS),
        # COCO's own evaluation skips crowds: that is what 'ignore' asks for.
        "iscrowd": int(label.ignore),
        "segmentation": [] if label.mask_code is None else _code(label.mask_code),
        "ignore": int(label.ignore),
        "pseudo": label.pseudo,
        "cut_off": label.cut_off,
    }
    if label.hidden_share is not None:
        item["hidden_share"] = label.hidden_share
    if label.amodal_code is not None:
        item["amodal_segmentation"] = _code(label.amodal_code)
    if label.keypoints is not None:
        item |= _keypoints(label.keypoints)
    if label.extras:
        item["extras"] = dict(label.extras)
    return item


def _keypoints(points: np.ndarray[Any, np.dtype[np.float64]]) -> dict[str, Any]:
    labelled = points[:, 2] > 0
    # COCO: a keypoint that is not labelled is 0, 0, 0.
    written = np.where(labelled[:, None], points + np.array([0.5, 0.5, 0.0]), 0.0)
    flat = [
        int(v) if k % 3 == 2 else round(float(v), _DIGITS) for k, v in enumerate(written.ravel())
    ]
    keys: dict[str, Any] = {"keypoints": flat, "num_keypoints": int(labelled.sum())}
    if (points[~labelled] != 0).any():
        # Where a point outside the picture lies is known of drawn fruit.
        keys["keypoints_px"] = np.round(points, _DIGITS).tolist()
    return keys


def _code(code: Rle) -> dict[str, Any]:
    return {"size": [code.height, code.width], "counts": code.counts}


def _json(data: Any) -> str:
    try:
        # NumPy's numbers and arrays become Python's.
        return (
            json.dumps(data, ensure_ascii=False, allow_nan=False, default=lambda one: one.tolist())
            + "\n"
        )
    except (AttributeError, TypeError, ValueError) as error:
        raise DataSetError(
            f"labels cannot be written as JSON ({error})", remedy="give finite plain numbers"
        ) from error
