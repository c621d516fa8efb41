"""Read and write data sets in COCO format, with additional keys in `annotations.json`.

The origin of COCO is the picture's corner, that of `Label` the centre of the first pixel: half a
pixel is added when writing and subtracted when reading. Other tools ignore the additional keys
and read the file as COCO with keypoints.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from cucumbervision.capture.camera_file import CameraModel
from cucumbervision.capture.pictures import MOST_PIXELS
from cucumbervision.errors import CucumberVisionError, DataSetError, InstancesError
from cucumbervision.files import parse_model, read_json
from cucumbervision.fruit.instance import KEYPOINT_NAMES, SKELETON
from cucumbervision.fruit.label_files import LabelledImage, entry_or_error, parse_coco
from cucumbervision.fruit.mask_codes import Rle
from cucumbervision_lab.arrays import Progress
from cucumbervision_lab.data.labels import (
    SPLIT_FOLDERS,
    DataSet,
    Label,
    LabelledPicture,
    flat_names,
    labels_of,
    place_file,
    ticked,
    write_text,
)

ANNOTATIONS = "annotations.json"

ROBOFLOW = "_annotations.coco.json"


def read_coco(path: Path) -> DataSet:
    """Read a data set in COCO format.

    Parameters
    ----------
    path : Path
        A folder with `annotations.json`; a Roboflow export with `_annotations.coco.json` in train/,
        valid/ and test/; or a COCO file with pictures in its folder or in images/.

    Returns
    -------
    DataSet
        Invalid annotations are listed in `refused`. Crowd regions become ignored labels.

    Raises
    ------
    CucumberVisionError
        If the file does not exist or is not in COCO format.
    """
    root = path if path.is_dir() else path.parent
    names: list[str] = []
    pictures: list[LabelledPicture] = []
    refused: list[CucumberVisionError] = []
    files = coco_files(path)
    if not files:
        raise DataSetError(
            f"holds neither {ANNOTATIONS} nor train/{ROBOFLOW}",
            source=path,
            remedy="give a COCO file or a folder that holds one",
        )
    for file, split in files:
        data = read_json(file)
        if not isinstance(data, dict):
            raise DataSetError("has no list of images", source=file, remedy="give COCO JSON")
        content = parse_coco(data, file)
        names += [name for name in content.class_names if name not in names]
        refused += content.refused
        for image in content.pictures:
            place = f"image {image.number or image.name}"
            read = entry_or_error(place, file, _picture, image, names, file, split, root)
            if isinstance(read, InstancesError):
                refused.append(read)
            else:
                pictures.append(read[0])
                refused += read[1]
    return DataSet(root, tuple(pictures), tuple(names), tuple(refused))


def coco_files(path: Path) -> list[tuple[Path, str]]:
    """Return the COCO files of a folder with the split of each, or a file itself."""
    if path.is_file():
        return [(path, "")]
    if (path / ANNOTATIONS).is_file():
        return [(path / ANNOTATIONS, "")]
    places = {path / folder / ROBOFLOW: split for folder, split in SPLIT_FOLDERS.items()}
    places[path / ROBOFLOW] = ""
    return [(file, split) for file, split in places.items() if file.is_file()]


def _picture(
    image: LabelledImage, names: Sequence[str], file: Path, split: str, root: Path
) -> tuple[LabelledPicture, list[InstancesError]]:
    """Return a labelled picture with the errors of its invalid annotations."""
    entry = image.entry
    if not entry:
        raise ValueError(f"has {len(image.records)} annotations but is not listed")
    width, height = image.size_px or (int(entry["width"]), int(entry["height"]))
    name = str(entry["file_name"]).replace("\\", "/")
    if min(width, height) < 1 or width * height > MOST_PIXELS:
        raise ValueError(f"its size {width}x{height} is out of range")
    labels, refused = labels_of(image, width, height, names, file)
    camera = None
    if entry.get("camera"):
        camera = parse_model(CameraModel, entry["camera"], source=file).intrinsics
    return LabelledPicture(
        file=_place(name, file.parent, root),
        width=width,
        height=height,
        labels=labels,
        scene=str(entry.get("scene", "")),
        split=str(entry.get("split", split)),
        source=str(entry.get("source", "")),
        licence=str(entry.get("licence", "")),
        depth_file=entry.get("depth_file"),
        depth_unit_m=float(entry.get("depth_unit_m", 0.001)),
        camera=camera,
        extras=dict(entry.get("extras", {})),
    ), refused


def _place(name: str, folder: Path, root: Path) -> str:
    for place in (folder / name, folder / "images" / name, folder.parent / "images" / name):
        if place.is_file() and place.is_relative_to(root):
            return place.relative_to(root).as_posix()
    return (folder / name).relative_to(root).as_posix()


_DIGITS = 3  # decimal places of pixels, far below the accuracy of labels


def write_coco(dataset: DataSet, folder: Path, *, progress: Progress | None = None) -> DataSet:
    """Write a data set in COCO format: `images/`, `depth/` and `annotations.json`.

    Parameters
    ----------
    dataset : DataSet
        Data set to write. If `folder` is its own folder, only `annotations.json` is rewritten.
    folder : Path
        Output folder; created if missing.
    progress : callable, optional
        Called with 1 after each picture.

    Returns
    -------
    DataSet
        The data set in `folder`.

    Raises
    ------
    DataSetError
        If a picture is missing or the folder is not writable.
    """
    pictures = dataset.pictures
    if folder.resolve() != dataset.folder.resolve():
        pictures = _place_all(dataset, folder, progress)
    write_annotations(map(coco_entries, pictures), dataset.categories, folder)
    return replace(dataset, folder=folder, pictures=tuple(pictures), refused=())


def write_annotations(
    entries: Iterable[Mapping[str, Any]], categories: Sequence[str], folder: Path
) -> None:
    """Write `annotations.json` from the `coco_entries` of its pictures.

    Raises
    ------
    DataSetError
        If the file cannot be written, or a number is not finite.
    """
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    for number, entry in enumerate(entries, 1):
        images.append({"id": number, **entry["image"]})
        for item in entry["annotations"]:
            annotations.append({"id": len(annotations) + 1, "image_id": number, **item})
    data = {
        "info": {"description": "CucumberVision data set", "version": "1"},
        "categories": _categories(categories),
        "images": images,
        "annotations": annotations,
    }
    write_text(folder / ANNOTATIONS, _json(data))


def _place_all(
    dataset: DataSet, folder: Path, progress: Progress | None
) -> tuple[LabelledPicture, ...]:
    placed = []
    names = flat_names(p.file for p in dataset.pictures)
    for picture in ticked(dataset.pictures, progress):
        name = names[picture.file]
        place_file(dataset.path(picture), folder / "images" / name)
        depth = picture.depth_file
        if depth is not None:
            target = PurePosixPath("depth", PurePosixPath(name).stem + PurePosixPath(depth).suffix)
            place_file(dataset.folder / depth, folder / target)
            depth = str(target)
        placed.append(replace(picture, file=f"images/{name}", depth_file=depth))
    return tuple(placed)


def _categories(names: Sequence[str]) -> list[dict[str, Any]]:
    return [
        {
            "id": k + 1,
            "name": name,
            "supercategory": "fruit",
            "keypoints": list(KEYPOINT_NAMES),
            "skeleton": [[a + 1, b + 1] for a, b in SKELETON],
        }
        for k, name in enumerate(names)
    ]


def coco_entries(picture: LabelledPicture) -> dict[str, Any]:
    """Return the entries of a picture in a COCO file: its `image` and its `annotations`."""
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
        # COCO's evaluation skips crowd regions, as required for ignored labels.
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
    # COCO writes unlabelled keypoints as 0, 0, 0.
    written = np.where(labelled[:, None], points + np.array([0.5, 0.5, 0.0]), 0.0)
    flat = [
        int(v) if k % 3 == 2 else round(float(v), _DIGITS) for k, v in enumerate(written.ravel())
    ]
    keys: dict[str, Any] = {"keypoints": flat, "num_keypoints": int(labelled.sum())}
    if (points[~labelled] != 0).any():
        # Synthetic fruit have known keypoints outside the picture.
        keys["keypoints_px"] = np.round(points, _DIGITS).tolist()
    return keys


def _code(code: Rle) -> dict[str, Any]:
    return {"size": [code.height, code.width], "counts": code.counts}


def _json(data: Any) -> str:
    try:
        # `default` converts NumPy numbers and arrays.
        return (
            json.dumps(
                data, ensure_ascii=False, allow_nan=False, default=lambda array: array.tolist()
            )
            + "\n"
        )
    except (AttributeError, TypeError, ValueError) as error:
        raise DataSetError(
            f"labels cannot be written as JSON ({error})", remedy="use finite numbers"
        ) from error
