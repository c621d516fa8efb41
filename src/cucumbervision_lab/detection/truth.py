"""The labelled test set: read, refused where it would lie, and put in the evaluation's terms."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.errors import CaptureError, DataSetError
from cucumbervision_lab.datasets.coco import read_coco
from cucumbervision_lab.datasets.labels import picture_size
from cucumbervision_lab.detection.pictures import Frame, TrueFruit

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from cucumbervision.capture.frames import Capture
    from cucumbervision_lab.datasets.labels import DataSet, Label, LabelledPicture

__all__ = ["DRAWN", "HeldOut", "capture_of", "frame_of", "read_held_out", "spread"]

DRAWN = "synth"
"""`LabelledPicture.source` of drawn pictures, the only ones that a report may show."""

_FRUIT, _ALSO_FRUIT = "cucumber", "zucchini"
_SHOWN = 10  # offenders named in one line


@dataclass(frozen=True)
class HeldOut:
    """The pictures to be judged.

    Parameters
    ----------
    data : DataSet
        The set that they are of.
    pictures : tuple of LabelledPicture
        Those of the split.
    split : str
        Which split.
    """

    data: DataSet
    pictures: tuple[LabelledPicture, ...]
    split: str


def read_held_out(folder: Path, split: str = "test", limit: int | None = None) -> HeldOut:
    """Read the pictures of one split.

    Parameters
    ----------
    folder : Path
        A set in the hub form, or anything that `read_coco` reads.
    split : str
        'test', or another split; 'all' takes every picture.
    limit : int, optional
        Take so many of them, evenly spread.

    Raises
    ------
    DataSetError
        If the set cannot be read in full, has no picture in the split, a label in it was drawn by
        a network, which is no truth, or a picture is missing or of another size.
    """
    data = read_coco(folder)
    if data.refused:
        raise DataSetError(
            f"{len(data.refused)} entries cannot be used, first: {data.refused[0]}",
            source=folder,
            remedy="correct them: a test with labels missing would blame the networks",
        )
    pictures = data.pictures if split == "all" else data.in_split(split)
    if not pictures:
        known = ", ".join(sorted({p.split for p in data.pictures if p.split})) or "none"
        raise DataSetError(
            f"no picture is in the split {split!r} (there are: {known})",
            source=folder,
            remedy="choose another --split, or 'all'",
        )
    pseudo = [p.file for p in pictures if any(one.pseudo and not one.ignore for one in p.labels)]
    if pseudo:
        raise DataSetError(
            f"{len(pseudo)} pictures of the split {split!r} have labels that a network drew: "
            + _named(pseudo),
            source=folder,
            remedy="a pseudo-label is no truth; move them to 'train'",
        )
    chosen = spread(pictures, limit)
    if faults := [fault for picture in chosen if (fault := _file_fault(picture, data))]:
        raise DataSetError(
            f"{len(faults)} pictures cannot be judged: {_named(faults)}",
            source=folder,
            remedy="copy the pictures that were labelled",
        )
    return HeldOut(data, chosen, split)


def _file_fault(picture: LabelledPicture, data: DataSet) -> str:
    """Say in a few words what is wrong with a picture's files; nothing if they are there."""
    path = data.path(picture)
    if not path.is_file():
        return f"{picture.file} is missing"
    if picture.depth_file is not None and not (data.folder / picture.depth_file).is_file():
        return f"{picture.depth_file} is missing"
    try:
        width, height = picture_size(path)
    except CaptureError as error:
        return f"{picture.file} {error.message}"
    if (width, height) == (picture.width, picture.height):
        return ""
    labelled = f"{picture.width}x{picture.height}"
    return f"{picture.file} has {width}x{height} pixels, its labels {labelled}"


def spread(items: tuple[Any, ...], limit: int | None) -> tuple[Any, ...]:
    """Take so many items, evenly spread over all.

    Examples
    --------
    >>> spread(("a", "b", "c", "d", "e"), 3)
    ('a', 'c', 'e')
    """
    if limit is None or limit >= len(items):
        return items
    return tuple(items[k] for k in np.linspace(0, len(items) - 1, limit).round().astype(int))


def frame_of(picture: LabelledPicture, data: DataSet, depth_m: NDArray[np.float32] | None) -> Frame:
    """Give a picture's truth as the evaluation takes it.

    Cucumbers are to be found; a zucchini may be, and need not; other classes are nothing.

    Parameters
    ----------
    picture : LabelledPicture
        Of the set.
    data : DataSet
        Its class names.
    depth_m : ndarray of float32, shape (H, W), optional
        For the distance of fruit whose label does not tell it.
    """
    true = []
    for label in picture.labels:
        name = data.categories[label.category].lower()
        # With one class it is the fruit, whatever it is called.
        fruit, optional = len(data.categories) == 1 or name == _FRUIT, name == _ALSO_FRUIT
        if fruit or optional or label.ignore:
            true.append(replace(_true_fruit(label, depth_m), optional=optional))
    scene = picture.scene or picture.file
    return Frame(picture.file, scene, picture.width, picture.height, tuple(true))


def _true_fruit(label: Label, depth_m: NDArray[np.float32] | None) -> TrueFruit:
    mask = label.mask_code
    code = None if mask is None else {"size": [mask.height, mask.width], "counts": mask.counts}
    extras = label.extras
    distance = extras.get("distance_m")
    if distance is None and depth_m is not None and mask is not None:
        read = depth_m[mask.decode()]
        read = read[read > 0]
        distance = float(np.median(read)) if read.size else None
    return TrueFruit(
        label.box,
        code,
        label.keypoints,
        label.ignore,
        hidden_share=math.nan if label.hidden_share is None else label.hidden_share,
        cut_off=label.cut_off,
        distance_m=math.nan if distance is None else float(distance),
        centreline_m=extras.get("centreline_m"),
        thread_m=extras.get("thread_m"),
        chord_m=extras.get("chord_m"),
    )


def capture_of(picture: LabelledPicture, data: DataSet, color: NDArray[np.uint8]) -> Capture | None:
    """Give the RGB-D frame of a picture, or None where it has no depth or no camera.

    Raises
    ------
    CaptureError
        If its depth picture cannot be read or has another size.
    """
    if picture.depth_file is None or picture.camera is None:
        return None
    from cucumbervision.capture.depth import depth_to_metres
    from cucumbervision.capture.files import read_depth
    from cucumbervision.capture.frames import Capture

    path = data.folder / picture.depth_file
    depth_m = depth_to_metres(read_depth(path), picture.depth_unit_m, source=path)
    return Capture(
        color,
        depth_m,
        picture.camera,
        name=Path(picture.file).stem,
        simulated=picture.source == DRAWN,
        source=str(path),
    )


def _named(files: list[str]) -> str:
    more = f" and {len(files) - _SHOWN} more" if len(files) > _SHOWN else ""
    return ", ".join(files[:_SHOWN]) + more
