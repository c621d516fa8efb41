"""Read data sets for Ultralytics: pictures, label files by split and `data.yaml`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

from cucumbervision.capture.files import read_bytes, read_json
from cucumbervision.errors import (
    CucumberVisionError,
    DataSetError,
    wrap_reader_errors,
)
from cucumbervision.perception.instance_files import parse_yolo_line
from cucumbervision.perception.mask_codes import Rle, mask_of_segmentation
from cucumbervision.perception.masks import box_of_mask
from cucumbervision_lab.datasets.labels import (
    DataSet,
    Label,
    LabelledPicture,
    list_pictures,
    picture_size,
)

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

PICTURES = "pictures.json"
"""Beside `data.yaml`: scene, source and licence of each picture, which the format has not."""

_KEYPOINTS = 5
_FOLDERS = {"train": "train", "val": "val", "valid": "val", "test": "test"}


@dataclass(frozen=True)
class YoloFolder:
    """What a YOLO folder says before its pictures are read.

    Parameters
    ----------
    folder : Path
        Where file names start.
    names : tuple of str
        The classes.
    pictures : tuple of (Path, str)
        Each picture and its split.
    keypoints : tuple of int, optional
        `kpt_shape`: how many, and numbers a keypoint.
    """

    folder: Path
    names: tuple[str, ...]
    pictures: tuple[tuple[Path, str], ...]
    keypoints: tuple[int, int] | None = None


def read_yolo(path: Path, names: Sequence[str] = ()) -> DataSet:
    """Read a YOLO data set: boxes, polygons or keypoints.

    Parameters
    ----------
    path : Path
        `data.yaml`, a folder with one, or a folder with images/ and labels/.
    names : sequence of str
        The classes, where no `data.yaml` names them.

    Returns
    -------
    DataSet
        Lines and pictures that cannot be used are in `refused`. A polygon becomes a mask.

    Raises
    ------
    DataSetError
        If there are no pictures, or the classes have no names.

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
    found = find_yolo(path, names)
    origins = _origins(found.folder)
    pictures: list[LabelledPicture] = []
    refused: list[CucumberVisionError] = []
    for file, split in found.pictures:
        name = file.relative_to(found.folder).as_posix()
        try:
            width, height = picture_size(file)
        except CucumberVisionError as error:
            refused.append(error)
            continue
        labels, bad = _read_labels(label_file(file), found, width, height)
        refused.extend(bad)
        origin = origins.get(name, {})
        pictures.append(LabelledPicture(name, width, height, tuple(labels), split=split, **origin))
    return DataSet(found.folder, tuple(pictures), found.names, refused=tuple(refused))


def find_yolo(path: Path, names: Sequence[str] = ()) -> YoloFolder:
    """Find a YOLO set's pictures, splits and classes; labels are not read.

    Raises
    ------
    DataSetError
        If there are no pictures, or the classes have no names.
    """
    yaml = path if path.is_file() else path / "data.yaml"
    folder = yaml.parent.resolve()
    data = load_data_yaml(yaml) if yaml.is_file() else {}
    with wrap_reader_errors(yaml, DataSetError, "correct it"):
        return _found(path, folder, yaml, data, list(names) or _names(data.get("names"), yaml))


def _found(
    path: Path, folder: Path, yaml: Path, data: dict[str, Any], named: list[str]
) -> YoloFolder:
    if not named:
        raise DataSetError(
            "the classes have no names", source=path, remedy="add data.yaml or give --names"
        )
    pictures = _listed(data, folder) or _lying(folder)
    if not pictures:
        raise DataSetError(
            "holds no pictures in images/", source=path, remedy="give a YOLO data set's folder"
        )
    shape = data.get("kpt_shape")
    if shape is not None and (len(shape) != 2 or shape[0] != _KEYPOINTS or shape[1] not in (2, 3)):
        raise DataSetError(
            f"kpt_shape is {shape}, not [5, 3] or [5, 2]",
            source=yaml,
            remedy="label five keypoints, blossom end to stem end",
        )
    return YoloFolder(folder, tuple(named), tuple(pictures), tuple(shape) if shape else None)


def load_data_yaml(path: Path) -> dict[str, Any]:
    """Read a `data.yaml`.

    Raises
    ------
    DataSetError
        If it is no YAML or describes no data set.
    """
    with wrap_reader_errors(path, DataSetError, "correct it"):
        text = read_bytes(path)
        try:
            # Lists of lists of lists, named and repeated, are small here and endless written out.
            if any(isinstance(token, yaml.AliasToken) for token in yaml.scan(text)):
                raise DataSetError("repeats a part by its name", source=path, remedy="write it out")
            data = yaml.safe_load(text)
        except yaml.YAMLError as error:
            raise DataSetError(f"is no YAML ({error})", source=path, remedy="correct it") from None
    if not isinstance(data, dict):
        raise DataSetError("is no data set's YAML", source=path, remedy="name train, val, names")
    return data


def _names(names: Any, yaml: Path) -> list[str]:
    if isinstance(names, dict):
        if sorted(names) != list(range(len(names))):
            raise DataSetError(
                "names do not count from 0 without a gap", source=yaml, remedy="correct them"
            )
        return [str(names[k]) for k in range(len(names))]
    return [str(name) for name in names or []]


def _listed(data: Mapping[str, Any], folder: Path) -> list[tuple[Path, str]]:
    """Return the pictures that `data.yaml` names: folders, lists, or text files of lists."""
    base = folder / str(data.get("path") or "")
    found: dict[Path, str] = {}
    for key, split in _FOLDERS.items():
        given = data.get(key)
        for entry in given if isinstance(given, list) else [given] if given else []:
            place = _resolve(str(entry), base, folder)
            if place.suffix == ".txt" and place.is_file():
                lines = place.read_text(encoding="utf-8").split("\n")
                files = [_resolve(x.strip(), place.parent, folder) for x in lines if x.strip()]
            else:
                files = list_pictures(place)
            for file in files:
                if file.is_relative_to(folder):
                    found.setdefault(file, split)
    return sorted(found.items())


def _resolve(entry: str, base: Path, folder: Path) -> Path:
    # Roboflow writes ../train/images for the folder beside data.yaml.
    inner = entry.replace("../", "")
    places = [base / entry, base / inner, folder / inner]
    for place in places:
        # The last part stays as it is: a picture may be a link to elsewhere.
        clean = place.parent.resolve() / place.name
        if clean.exists() and clean.is_relative_to(folder):
            return clean
    return places[0]


def _lying(folder: Path) -> list[tuple[Path, str]]:
    found = []
    for file in list_pictures(folder):
        parts = file.relative_to(folder).parts[:-1]
        if "images" in parts:
            found.append((file, next((_FOLDERS[p] for p in parts if p in _FOLDERS), "")))
    return found


def label_file(picture: Path, kind: str = "labels") -> Path:
    """Return the label file of a picture, as Ultralytics finds it.

    Parameters
    ----------
    picture : Path
        Below a folder `images`.
    kind : str
        'labels', or 'ignored' for the outlines of regions to ignore.

    Examples
    --------
    >>> label_file(Path("set/images/train/a.jpg")).as_posix()
    'set/labels/train/a.txt'
    """
    parts = list(picture.parts)
    for k in range(len(parts) - 2, -1, -1):
        if parts[k] == "images":
            parts[k] = kind
            break
    return Path(*parts).with_suffix(".txt")


def _origins(folder: Path) -> dict[str, dict[str, Any]]:
    file = folder / PICTURES
    data = read_json(file) if file.is_file() else {}
    if not isinstance(data, dict) or not all(isinstance(v, dict) for v in data.values()):
        raise DataSetError("is no object of pictures", source=file, remedy="remove it")
    keys = ("scene", "source", "licence")
    return {name: {k: str(v[k]) for k in keys if v.get(k)} for name, v in data.items()}


def _read_labels(
    file: Path, found: YoloFolder, width: int, height: int
) -> tuple[list[Label], list[CucumberVisionError]]:
    try:
        lines = file.read_text(encoding="utf-8").splitlines()
    except FileNotFoundError:
        fault = DataSetError(
            "the label file is missing", source=file, remedy="write an empty one if there is none"
        )
        return [], [fault]
    except (OSError, ValueError) as error:
        return [], [DataSetError(f"is no text ({error})", source=file, remedy="write it again")]
    labels: list[Label] = []
    refused: list[CucumberVisionError] = []
    for i, line in enumerate(lines, 1):
        if not line.strip():
            continue
        try:
            labels.append(read_label_line(line, found, width, height)[0])
        except ValueError as error:
            refused.append(DataSetError(f"line {i}: {error}", source=file, remedy="correct it"))
    return labels, refused


def read_label_line(
    line: str, found: YoloFolder, width: int, height: int
) -> tuple[Label, NDArray[np.float64] | None]:
    """Read one line of a label file.

    Parameters
    ----------
    line : str
        'class cx cy w h', a polygon, or a box with keypoints.
    found : YoloFolder
        Whose classes and keypoints the line must fit.
    width, height : int
        The picture's size.

    Returns
    -------
    label : Label
    polygon : ndarray, shape (K, 2), optional
        In pixels from the picture's corner, where the line is one.

    Raises
    ------
    ValueError
        What is wrong with the line.
    """
    numbers = line.split()
    if found.keypoints is not None:
        points, each = found.keypoints
        if len(numbers) != 5 + points * each:
            raise ValueError(
                f"has {len(numbers)} numbers, not {5 + points * each} (box and {points} keypoints)"
            )
        if each == 2:
            pairs = [numbers[k : k + 2] for k in range(5, len(numbers), 2)]
            numbers = numbers[:5] + [v for pair in pairs for v in (*pair, "2")]
    record = parse_yolo_line(" ".join(numbers), "", list(found.names))
    category = int(float(numbers[0]))
    if category >= len(found.names):
        raise ValueError(f"its class {category} has no name")
    size = np.array([width, height], np.float64)
    if record.polygons:
        polygon = record.polygons[0] * size
        mask = mask_of_segmentation([polygon.ravel()], height, width)
        return Label(box_of_mask(mask), category, Rle.of(mask)), polygon
    edges = record.box
    if edges is None or (edges[2:] <= edges[:2]).any():
        raise ValueError("its box has no area")
    keypoints = record.keypoints
    if keypoints is not None:
        keypoints = keypoints.copy()
        keypoints[:, 2] *= 2
        seen = keypoints[:, 2:] > 0
        keypoints[:, :2] = np.where(seen, keypoints[:, :2] * size - 0.5, 0.0)
    box = np.clip(edges, 0, 1) * np.tile(size, 2) - 0.5
    return Label(box, category, keypoints=keypoints), None
