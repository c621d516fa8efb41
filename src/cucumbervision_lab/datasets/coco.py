"""The hub form: a folder of pictures with one `annotations.json`, which is COCO and more.

COCO counts from the picture's corner, `Label` from the first pixel's centre: half a pixel is
added on writing and taken off on reading. What COCO has no key for stands beside its keys, so that
other tools read the file as plain COCO with keypoints.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.capture.camera_file import CameraModel
from cucumbervision.capture.files import parse_model, read_json
from cucumbervision.errors import (
    CaptureError,
    CucumberVisionError,
    DataSetError,
    wrap_reader_errors,
)
from cucumbervision.perception.instances import KEYPOINT_NAMES
from cucumbervision.perception.mask_codes import Rle, mask_of_segmentation
from cucumbervision.perception.masks import box_of_mask
from cucumbervision_lab.datasets.labels import (
    DataSet,
    Label,
    LabelledPicture,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from numpy.typing import NDArray

ANNOTATIONS = "annotations.json"

ROBOFLOW = "_annotations.coco.json"

_FOLDERS = {"train": "train", "valid": "val", "val": "val", "test": "test"}
_KEYPOINTS = 5
_FAULTS = (AttributeError, KeyError, TypeError, ValueError, OverflowError)  # of wrong types
_MOST_PIXELS = 2**30  # as OpenCV reads at most


def read_coco(path: Path) -> DataSet:
    """Read a hub folder, a COCO file, or a Roboflow export of COCO.

    Parameters
    ----------
    path : Path
        A folder with `annotations.json`; a folder whose train/, valid/ and test/ hold
        `_annotations.coco.json`; or a COCO file, whose pictures lie beside it or in images/.

    Returns
    -------
    DataSet
        Annotations that cannot be used are in `refused`, everything else in `pictures`.
        Crowd regions become labels to ignore.

    Raises
    ------
    DataSetError
        If there is no such file, or it is no COCO.
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
            found, bad = _read_pictures(data, ids, file, split, root)
        pictures.extend(found)
        refused.extend(bad)
    with wrap_reader_errors(sources[0][0], DataSetError, "give COCO JSON"):
        points = _keypoint_names(files[0])
    return DataSet(root, tuple(pictures), tuple(names), points, refused=tuple(refused))


def coco_files(path: Path) -> list[Path]:
    """Return the COCO files of a set: one, or one a split."""
    return [file for file, _ in _find(path)]


def _find(path: Path) -> list[tuple[Path, str]]:
    if path.is_file():
        return [(path, "")]
    if (path / ANNOTATIONS).is_file():
        return [(path / ANNOTATIONS, "")]
    found = [
        (path / folder / ROBOFLOW, split)
        for folder, split in _FOLDERS.items()
        if (path / folder / ROBOFLOW).is_file()
    ]
    if (path / ROBOFLOW).is_file():
        found.append((path / ROBOFLOW, ""))
    if not found:
        raise DataSetError(
            f"holds neither {ANNOTATIONS} nor train/{ROBOFLOW}",
            source=path,
            remedy="give a COCO file or a folder that holds one",
        )
    return found


def _category_indices(data: Mapping[str, Any], names: list[str]) -> dict[int, int]:
    """Return the index of each category id, and add new names."""
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


def _keypoint_names(data: Mapping[str, Any]) -> tuple[str, ...]:
    for category in data.get("categories", []):
        found = category.get("keypoints") if isinstance(category, dict) else None
        if isinstance(found, list) and len(found) == _KEYPOINTS:
            return tuple(str(name) for name in found)
    return KEYPOINT_NAMES


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
        own = items.pop(key, [])
        try:
            picture, bad = picture_of(image, own, ids, file, split, root)
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
    """Make one picture of COCO's keys.

    Parameters
    ----------
    image : mapping
        An entry of COCO's images.
    annotations : iterable of mapping
        The annotations of this image.
    ids : mapping of int to int
        Index of each category id.
    file : Path
        The JSON file, for errors, and where the search for the picture starts.
    split : str
        Of the pictures that name none.
    root : Path, optional
        The set's folder; without it file names are taken as they are.

    Returns
    -------
    picture : LabelledPicture
    refused : list of DataSetError
        Annotations that cannot be used.

    Raises
    ------
    KeyError, TypeError, ValueError, OverflowError
        If the picture's own keys are missing or wrong.
    """
    width, height = int(image["width"]), int(image["height"])
    name = str(image["file_name"]).replace("\\", "/")
    if min(width, height) < 1 or width * height > _MOST_PIXELS:
        raise ValueError(f"its size {width}x{height} is no picture")
    labels: list[Label] = []
    refused: list[CucumberVisionError] = []
    for i, item in enumerate(annotations):
        try:
            if not isinstance(item, dict):
                raise TypeError("is no object")
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
        what = f"has no {what}"
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
        raise ValueError(f"its box {numbers} reaches beyond the picture of {width}x{height}")
    cut: NDArray[np.float64] = np.clip(box, 0, [width, height, width, height]) - 0.5
    return cut


def _mask(shape: Any, width: int, height: int) -> Rle | None:
    """Return the run lengths of COCO's 'segmentation', None where it is empty."""
    return Rle.of(mask_of_segmentation(shape, height, width)) if shape else None


def _points(item: Mapping[str, Any]) -> NDArray[np.float64] | None:
    if item.get("keypoints_px"):
        points = np.array(item["keypoints_px"], np.float64)
    elif item.get("keypoints"):
        flat = np.array(item["keypoints"], np.float64)
        if flat.shape != (3 * _KEYPOINTS,):
            raise ValueError(f"has {flat.size} keypoint numbers, not {3 * _KEYPOINTS}")
        points = flat.reshape(_KEYPOINTS, 3)
        points[:, :2] -= 0.5 * (points[:, 2:] > 0)
    else:
        return None
    if points.shape != (_KEYPOINTS, 3) or not np.isfinite(points).all():
        raise ValueError("its keypoints are not 5 x 3 finite numbers")
    if not np.isin(points[:, 2], (0, 1, 2)).all():
        raise ValueError("a keypoint's visibility is none of 0, 1, 2")
    return points


def collect_fragments(
    folder: Path, fragments: str = "fragments", categories: tuple[str, ...] = ("cucumber",)
) -> DataSet:
    """Read the fragments of a set, in the order of their names.

    Parameters
    ----------
    folder : Path
        The set's folder, where the pictures' names start.
    fragments : str
        The fragments' folder in it.
    categories : tuple of str
        The classes' names.

    Returns
    -------
    DataSet
        `write_coco(dataset, folder)` makes it a hub folder. A damaged fragment is in `refused`.
    """
    pictures: list[LabelledPicture] = []
    refused: list[CucumberVisionError] = []
    for file in sorted((folder / fragments).glob("*.json")):
        try:
            data = read_json(file)
            if not isinstance(data, dict) or not {"image", "annotations"} <= set(data):
                raise CaptureError("is no fragment", source=file, remedy="make the frame again")
            ids = {k + 1: k for k in range(len(categories))}
            picture, bad = picture_of(data["image"], data["annotations"], ids, file)
        except (CucumberVisionError, *_FAULTS) as error:
            if not isinstance(error, CucumberVisionError):
                error = DataSetError(f"is no fragment ({error})", source=file)
            refused.append(error)
        else:
            pictures.append(picture)
            refused.extend(bad)
    return DataSet(folder, tuple(pictures), categories, refused=tuple(refused))
