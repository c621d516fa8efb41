"""Instances from files: boxes and masks that people drew or another detector found.

COCO and YOLO count from the picture's corner, `Instance` from the first pixel's centre: half a
pixel is taken off.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.errors import InstancesError
from cucumbervision.perception.instance_formats import (
    Picture,
    Record,
    parse_yolo_line,
    read_coco,
    read_yolo_classes,
)
from cucumbervision.perception.instances import Instance, MaskSource, box_of_mask
from cucumbervision.perception.mask_codes import decode_rle, fill_polygon

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

__all__ = ["FileInstances", "InstanceFile", "read_instances"]

_CLIP_SLACK_PX = 0.01  # boxes written with few digits are not called clipped


@dataclass(frozen=True, eq=False)
class FileInstances:
    """What a file gives for one picture.

    Parameters
    ----------
    instances : tuple of Instance
        In the file's order; boxes lie within the picture.
    clipped : tuple of bool
        For each instance, whether its box reached beyond the picture and was cut.
    refused : tuple of InstancesError
        What could not be used, each with its place in the file.
    """

    instances: tuple[Instance, ...]
    clipped: tuple[bool, ...]
    refused: tuple[InstancesError, ...]


@dataclass(frozen=True, eq=False)
class InstanceFile:
    """A file of instances for many pictures; `read_instances` makes it.

    Parameters
    ----------
    source : str
        The file or folder.
    pictures : tuple of Picture
        What it says of each picture.
    """

    source: str
    pictures: tuple[Picture, ...]

    def for_capture(
        self, names: Sequence[str], width: int, height: int, *, frame: int | None = None
    ) -> FileInstances:
        """Give the instances of one picture.

        Parameters
        ----------
        names : sequence of str
            What the picture may be called: the capture's name, its colour file. Compared whole,
            then without folder, then without folder and ending.
        width, height : int
            The picture's size in pixels.
        frame : int, optional
            The picture's number, compared with COCO's image ids where no name fits.

        Returns
        -------
        FileInstances

        Raises
        ------
        InstancesError
            If the file does not name the picture, names it twice, or gives it another size.
        """
        picture = self._find([n for n in names if n], frame)
        if picture.size_px is not None and picture.size_px != (width, height):
            raise InstancesError(
                f"gives {picture.name or picture.number} the size "
                f"{picture.size_px[0]}x{picture.size_px[1]}, the picture is {width}x{height}",
                source=self.source,
                remedy="give the annotations of this very picture",
            )
        instances, clipped, refused = [], [], []
        for record in picture.records:
            if isinstance(record, InstancesError):
                refused.append(record)
                continue
            try:
                instance, cut = _instance(record, width, height)
            except (TypeError, ValueError, KeyError) as error:
                fault = f"{record.where}: {error}"
                refused.append(InstancesError(fault, source=self.source, remedy="correct it"))
            else:
                instances.append(instance)
                clipped.append(cut)
        return FileInstances(tuple(instances), tuple(clipped), tuple(refused))

    def _find(self, names: Sequence[str], frame: int | None) -> Picture:
        for short in (_whole, _file_name, _stem):
            # A capture's name may hold dots and have no ending.
            wanted = {short(n) for n in names} | {_file_name(n) for n in names if short is _stem}
            found = [p for p in self.pictures if p.name and short(p.name) in wanted]
            if len(found) == 1:
                return found[0]
            if found:
                raise InstancesError(
                    f"names {' or '.join(sorted(wanted))} {len(found)} times",
                    source=self.source,
                    remedy="give the pictures different names",
                )
        for picture in self.pictures:
            if frame is not None and picture.number == frame:
                return picture
        known = ", ".join(p.name or str(p.number) for p in self.pictures[:3]) or "none"
        raise InstancesError(
            f"does not name the picture {' or '.join(names) or frame} (it names {known})",
            source=self.source,
            remedy="name its pictures as the captures are called; where a picture holds no fruit,"
            " list it without annotations (YOLO: an empty file)",
        )


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

    Raises
    ------
    InstancesError
        If there is no such file, or it is none of these.
    """
    path = Path(path)
    if path.is_dir():
        pictures = _read_yolo_folder(path)
    elif not path.is_file():
        raise InstancesError("there is no such file", source=path, remedy="check the path")
    elif path.suffix.lower() == ".json":
        pictures = read_coco(path)
    elif path.suffix.lower() == ".txt":
        pictures = [_read_yolo_file(path, read_yolo_classes(path.parent))]
    else:
        raise InstancesError(
            "is of no known kind", source=path, remedy="give COCO JSON or YOLO txt"
        )
    return InstanceFile(str(path), tuple(pictures))


def _read_yolo_folder(folder: Path) -> list[Picture]:
    for place in (folder, folder / "labels"):
        files = sorted(f for f in place.glob("*.txt") if f.name != "classes.txt")
        if files:
            names = read_yolo_classes(place) or read_yolo_classes(folder)
            return [_read_yolo_file(file, names) for file in files]
    raise InstancesError("holds no label files", source=folder, remedy="give YOLO txt files")


def _read_yolo_file(path: Path, names: list[str]) -> Picture:
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, ValueError) as error:
        raise InstancesError(
            f"is no text ({error})", source=path, remedy="write it again"
        ) from error
    records: list[Record | InstancesError] = []
    for i, line in enumerate(lines, 1):
        if not line.strip():
            continue
        try:
            records.append(parse_yolo_line(line, f"{path.name}, line {i}", names))
        except ValueError as error:
            records.append(InstancesError(f"line {i}: {error}", source=path, remedy="correct it"))
    return Picture(path.name, None, None, records)


def _instance(record: Record, width: int, height: int) -> tuple[Instance, bool]:
    scale = np.array([width, height] if record.normalised else [1, 1], np.float64)
    mask = _mask(record, scale, width, height)
    if record.box is not None:
        box, clipped = _clip(record.box * np.tile(scale, 2), width, height)
    elif mask is not None:
        outline = [p * scale for p in record.polygons]
        reach = np.concatenate(outline) if outline else np.zeros((1, 2))
        box, clipped = box_of_mask(mask), bool(_beyond(reach, width, height).any())
    else:
        raise ValueError("has neither box nor mask")
    keypoints = None
    if record.keypoints is not None:
        keypoints = record.keypoints.copy()
        keypoints[:, :2] = keypoints[:, :2] * scale - 0.5
    if not 0 <= record.score <= 1:
        raise ValueError(f"has the score {record.score:g}, outside 0 to 1")
    return Instance(
        box=box,
        score=record.score,
        label=record.label,
        mask=mask,
        mask_source=None if mask is None else MaskSource.DATASET,
        keypoints=keypoints,
    ), clipped


def _mask(
    record: Record, scale: NDArray[np.float64], width: int, height: int
) -> NDArray[np.bool_] | None:
    if record.rle is not None:
        rows, columns = record.rle["size"]
        if (rows, columns) != (height, width):
            raise ValueError(f"has a mask of {columns}x{rows}, the picture is {width}x{height}")
        mask = decode_rle(record.rle["counts"], height, width)
    elif record.polygons:
        parts = [fill_polygon(p * scale, height, width) for p in record.polygons]
        mask = np.logical_or.reduce(parts)
    else:
        return None
    if not mask.any():
        raise ValueError("its mask covers no pixel of the picture")
    return mask


def _clip(box: NDArray[np.float64], width: int, height: int) -> tuple[NDArray[np.float64], bool]:
    """Cut a box, given from the corner, to the picture; give it from the first pixel's centre."""
    if box[2] <= box[0] or box[3] <= box[1]:
        raise ValueError("its box has no area")
    low, high = np.maximum(box[:2], 0), np.minimum(box[2:], (width, height))
    if (high <= low).any():
        raise ValueError(f"its box lies outside the picture of {width}x{height}")
    clipped = bool(_beyond(box.reshape(2, 2), width, height).any())
    return np.concatenate([low, high]) - 0.5, clipped


def _beyond(points: NDArray[np.float64], width: int, height: int) -> NDArray[np.bool_]:
    return (points < -_CLIP_SLACK_PX) | (points > np.array([width, height]) + _CLIP_SLACK_PX)


def _whole(name: str) -> str:
    return name


def _file_name(name: str) -> str:
    return PurePosixPath(name.replace("\\", "/")).name


def _stem(name: str) -> str:
    return PurePosixPath(_file_name(name)).stem
