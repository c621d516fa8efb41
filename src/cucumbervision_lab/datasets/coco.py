"""Read and write data sets in COCO format, with additional keys in `annotations.json`.

The origin of COCO is the picture's corner, that of `Label` the centre of the first pixel: half a
pixel is added when writing and subtracted when reading. Other tools ignore the additional keys
and read the file as COCO with keypoints.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.capture.camera_file import CameraModel
from cucumbervision.capture.pictures import MOST_PIXELS
from cucumbervision.errors import (
    CaptureError,
    CucumberVisionError,
    DataSetError,
    wrap_reader_errors,
)
from cucumbervision.files import parse_model, read_json
from cucumbervision.instances.instance import KEYPOINT_NAMES, SKELETON
from cucumbervision.instances.mask_codes import Rle, mask_of_segmentation
from cucumbervision.instances.masks import box_of_mask
from cucumbervision_lab.datasets.labels import (
    SPLIT_FOLDERS,
    DataSet,
    Label,
    LabelledPicture,
    flat_names,
    place_file,
    ticked,
    write_text,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from numpy.typing import NDArray

ANNOTATIONS = "annotations.json"

FRAGMENTS = "fragments"
"""Subfolder of the labels of single pictures."""
ROBOFLOW = "_annotations.coco.json"

_KEYPOINTS = 5
# Raised by values of the wrong type.
_FAULTS = (AttributeError, KeyError, TypeError, ValueError, OverflowError)


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
    DataSetError
        If the file does not exist or is not in COCO format.
    """
    sources = _find(path)
    files = [read_json(file) for file, _ in sources]
    for (file, _), data in zip(sources, files, strict=True):
        if not isinstance(data, dict) or not isinstance(data.get("images"), list):
            raise DataSetError("has no list of images", source=file, remedy="give COCO JSON")
    root = path if path.is_dir() else path.parent
    names: list[str] = []
    pictures: list[LabelledPicture] = []
    refused: list[CucumberVisionError] = []
    for (file, split), data in zip(sources, files, strict=True):
        with wrap_reader_errors(file, DataSetError, "give COCO JSON"):
            ids = _category_indices(data, names)
            loaded, bad = _read_pictures(data, ids, file, split, root)
        pictures.extend(loaded)
        refused.extend(bad)
    return DataSet(root, tuple(pictures), tuple(names), tuple(refused))


def _find(path: Path) -> list[tuple[Path, str]]:
    if path.is_file():
        return [(path, "")]
    if (path / ANNOTATIONS).is_file():
        return [(path / ANNOTATIONS, "")]
    annotations = [
        (path / folder / ROBOFLOW, split)
        for folder, split in SPLIT_FOLDERS.items()
        if (path / folder / ROBOFLOW).is_file()
    ]
    if (path / ROBOFLOW).is_file():
        annotations.append((path / ROBOFLOW, ""))
    if not annotations:
        raise DataSetError(
            f"holds neither {ANNOTATIONS} nor train/{ROBOFLOW}",
            source=path,
            remedy="give a COCO file or a folder that holds one",
        )
    return annotations


def _category_indices(data: Mapping[str, Any], names: list[str]) -> dict[int, int]:
    """Return the index of each category id, and append new names to `names`."""
    categories = [c for c in data.get("categories", []) if isinstance(c, dict) and "id" in c]
    used = {a.get("category_id") for a in data.get("annotations", []) if isinstance(a, dict)}
    parents = {c.get("supercategory") for c in categories}
    ids: dict[int, int] = {}
    for category in sorted(categories, key=lambda c: int(c["id"])):
        name = str(category.get("name", category["id"]))
        # Roboflow's category 0 is only the name of the group.
        if name in parents and category["id"] not in used and len(categories) > 1:
            continue
        if name not in names:
            names.append(name)
        ids[int(category["id"])] = names.index(name)
    return ids


def _read_pictures(
    data: Mapping[str, Any], ids: Mapping[int, int], file: Path, split: str, root: Path
) -> tuple[list[LabelledPicture], list[CucumberVisionError]]:
    items: dict[Any, list[Any]] = {}
    refused: list[CucumberVisionError] = []
    for i, item in enumerate(data.get("annotations", [])):
        if isinstance(item, dict) and "image_id" in item:
            items.setdefault(item["image_id"], []).append(item)
        else:
            refused.append(_fault(file, f"annotation {i}", "names no picture"))
    pictures = []
    for i, image in enumerate(data["images"]):
        key = image.get("id") if isinstance(image, dict) else None
        entries = items.pop(key, [])
        try:
            picture, bad = picture_of(image, entries, ids, file, split, root)
        except (CucumberVisionError, *_FAULTS) as error:
            refused.append(_fault(file, f"image {key if key is not None else i}", error))
        else:
            pictures.append(picture)
            refused.extend(bad)
    for key, lost in items.items():
        number = f"image {key}"
        refused.append(_fault(file, number, f"has {len(lost)} annotations but is not listed"))
    return pictures, refused


def picture_of(
    image: Mapping[str, Any],
    annotations: Iterable[Any],
    ids: Mapping[int, int],
    file: Path,
    split: str = "",
    root: Path | None = None,
) -> tuple[LabelledPicture, list[CucumberVisionError]]:
    """Create a labelled picture from COCO entries.

    Parameters
    ----------
    image : mapping
        An entry of COCO's images.
    annotations : iterable of mapping
        The annotations of this image.
    ids : mapping of int to int
        Index of each category id.
    file : Path
        The JSON file, for error messages and to locate the picture.
    split : str
        Split of a picture without the key 'split'.
    root : Path, optional
        Folder of the data set; if omitted, the file name is not resolved.

    Returns
    -------
    picture : LabelledPicture
        The picture with its valid annotations.
    refused : list of DataSetError
        Errors of the invalid annotations.

    Raises
    ------
    KeyError, TypeError, ValueError, OverflowError
        If keys of the image are missing or invalid.
    """
    width, height = int(image["width"]), int(image["height"])
    name = str(image["file_name"]).replace("\\", "/")
    if min(width, height) < 1 or width * height > MOST_PIXELS:
        raise ValueError(f"its size {width}x{height} is out of range")
    labels: list[Label] = []
    refused: list[CucumberVisionError] = []
    for i, item in enumerate(annotations):
        try:
            if not isinstance(item, dict):
                raise TypeError("is not an object")
            labels.append(_label(item, ids, width, height))
        except _FAULTS as error:
            number = item.get("id", i) if isinstance(item, dict) else i
            refused.append(_fault(file, f"annotation {number} ({name})", error))
    camera = None
    if image.get("camera"):
        camera = parse_model(
            CameraModel, image["camera"], source=file, error=DataSetError
        ).intrinsics
    return LabelledPicture(
        file=name if root is None else _place(name, file.parent, root),
        width=width,
        height=height,
        labels=tuple(labels),
        scene=str(image.get("scene", "")),
        split=str(image.get("split", split)),
        source=str(image.get("source", "")),
        licence=str(image.get("licence", "")),
        depth_file=image.get("depth_file"),
        depth_unit_m=float(image.get("depth_unit_m", 0.001)),
        camera=camera,
        extras=dict(image.get("extras", {})),
    ), refused


def _place(name: str, folder: Path, root: Path) -> str:
    for place in (folder / name, folder / "images" / name, folder.parent / "images" / name):
        if place.is_file() and place.is_relative_to(root):
            return place.relative_to(root).as_posix()
    return (folder / name).relative_to(root).as_posix()


def _fault(file: Path, where: str, what: object) -> DataSetError:
    if isinstance(what, KeyError):
        what = f"key {what} is missing"
    return DataSetError(f"{where}: {what}", source=file, remedy="correct or export it again")


def _label(item: Mapping[str, Any], ids: Mapping[int, int], width: int, height: int) -> Label:
    category = item.get("category_id", 1)
    if category not in ids:
        raise ValueError(f"its category {category} is not listed")
    code = _mask(item.get("segmentation"), width, height)
    box = _box(item.get("bbox"), code, width, height)
    hidden = item.get("hidden_share")
    return Label(
        box=box,
        category=ids[category],
        mask_code=code,
        amodal_code=_mask(item.get("amodal_segmentation"), width, height),
        keypoints=_points(item),
        hidden_share=None if hidden is None else float(hidden),
        cut_off=bool(item.get("cut_off", False)),
        ignore=bool(item.get("ignore") or item.get("iscrowd")),
        pseudo=bool(item.get("pseudo", False)),
        extras=dict(item.get("extras", {})),
    )


def _box(values: Any, code: Rle | None, width: int, height: int) -> NDArray[np.float64]:
    if not values:
        if code is None:
            raise ValueError("has neither box nor mask")
        return box_of_mask(code.decode())
    x, y, w, h = numbers = [float(v) for v in values]
    if not np.isfinite(numbers).all() or w <= 0 or h <= 0:
        raise ValueError(f"its box {numbers} has no area")
    box = np.array([x, y, x + w, y + h])
    slack = 1.0  # tools round boxes to whole pixels
    if (box[:2] < -slack).any() or box[2] > width + slack or box[3] > height + slack:
        raise ValueError(f"its box {numbers} extends beyond the picture of {width}x{height}")
    cut: NDArray[np.float64] = np.clip(box, 0, [width, height, width, height]) - 0.5
    return cut


def _mask(shape: Any, width: int, height: int) -> Rle | None:
    """Return COCO's 'segmentation' as run lengths, or None if it is empty."""
    return Rle.of(mask_of_segmentation(shape, height, width)) if shape else None


def _points(item: Mapping[str, Any]) -> NDArray[np.float64] | None:
    if item.get("keypoints_px"):
        points = np.array(item["keypoints_px"], np.float64)
    elif item.get("keypoints"):
        flat = np.array(item["keypoints"], np.float64)
        if flat.shape != (3 * _KEYPOINTS,):
            raise ValueError(f"has {flat.size} keypoint values, expected {3 * _KEYPOINTS}")
        points = flat.reshape(_KEYPOINTS, 3)
        points[:, :2] -= 0.5 * (points[:, 2:] > 0)
    else:
        return None
    if points.shape != (_KEYPOINTS, 3) or not np.isfinite(points).all():
        raise ValueError("its keypoints are not 5 x 3 finite numbers")
    if not np.isin(points[:, 2], (0, 1, 2)).all():
        raise ValueError("a keypoint's visibility is not 0, 1 or 2")
    return points


def collect_fragments(folder: Path) -> DataSet:
    """Read the fragments of a data set in the order of their file names.

    Parameters
    ----------
    folder : Path
        Folder of the data set; picture names are relative to it.

    Returns
    -------
    DataSet
        The combined data set; write it with `write_coco(dataset, folder)`. Errors of damaged
        fragments are listed in `refused`.
    """
    pictures: list[LabelledPicture] = []
    refused: list[CucumberVisionError] = []
    for file in sorted((folder / FRAGMENTS).glob("*.json")):
        try:
            data = read_json(file)
            if not isinstance(data, dict) or not {"image", "annotations"} <= set(data):
                raise CaptureError(
                    "is not a fragment", source=file, remedy="generate the frame again"
                )
            picture, bad = picture_of(data["image"], data["annotations"], {1: 0}, file)
        except (CucumberVisionError, *_FAULTS) as error:
            if not isinstance(error, CucumberVisionError):
                error = DataSetError(f"is not a fragment ({error})", source=file)
            refused.append(error)
        else:
            pictures.append(picture)
            refused.extend(bad)
    return DataSet(folder, tuple(pictures), refused=tuple(refused))


_DIGITS = 3  # decimal places of pixels, far below the accuracy of labels


def write_coco(
    dataset: DataSet,
    folder: Path,
    *,
    progress: Callable[[int], None] | None = None,
) -> DataSet:
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
    """Write the labels of one picture to a JSON file of its own.

    Intended for parallel generators that may be interrupted: each frame is written atomically, and
    `collect_fragments` combines them.

    Parameters
    ----------
    picture : LabelledPicture
        The picture; its image file should already exist.
    file : Path
        Output file ending in .json, such as `set/fragments/000001.json`.

    Returns
    -------
    Path
        `file`.

    Raises
    ------
    DataSetError
        If the file cannot be written.
    """
    write_text(file, _json(_fragment(picture)))
    return file


def _place_all(
    dataset: DataSet, folder: Path, progress: Callable[[int], None] | None
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


def _categories(dataset: DataSet) -> list[dict[str, Any]]:
    return [
        {
            "id": k + 1,
            "name": name,
            "supercategory": "fruit",
            "keypoints": list(KEYPOINT_NAMES),
            "skeleton": [[a + 1, b + 1] for a, b in SKELETON],
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
