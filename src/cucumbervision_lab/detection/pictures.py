"""One labelled picture: its true fruit, what the networks found in it, and how it is read."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.capture.frames import valid_depth
from cucumbervision.errors import CaptureError, DataSetError, MissingExtraError
from cucumbervision_lab.datasets.coco import read_coco
from cucumbervision_lab.datasets.labels import picture_size

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from cucumbervision.capture.frames import Capture
    from cucumbervision.perception.instances import Instance
    from cucumbervision_lab.datasets.labels import DataSet, Label, LabelledPicture

Code = dict[str, Any]
"""A mask as pycocotools keeps it: `size` (H, W) and compressed run lengths."""


def import_pycocotools() -> Any:
    """Import pycocotools' masks.

    Raises
    ------
    MissingExtraError
        If it is not installed.
    """
    try:
        from pycocotools import mask
    except ImportError:
        raise MissingExtraError("pycocotools", "benchmark") from None
    return mask


class Stage(StrEnum):
    """Whose detections are judged."""

    SEGMENTED = "segmenting network"
    POSED = "pose network"
    KEPT = "what is reported"


@dataclass(frozen=True, eq=False)
class TrueFruit:
    """A fruit that is truly there, or a region that is not to be judged.

    Parameters
    ----------
    box : ndarray of float64, shape (4,)
        Edges x1, y1, x2, y2 of what shows of it, pixels.
    code : dict, optional
        The mask of what shows, coded.
    keypoints : ndarray of float64, shape (5, 3), optional
        u, v in pixels and COCO's visibility: 2 seen, 1 hidden, 0 not labelled or outside the
        picture (0, 0 where its place is not known).
    ignore : bool
        True for regions that are not to be judged.
    optional : bool
        True for what may be found, once, but need not be: a zucchini.
    hidden_share : float
        Share of its outline that something hides, 0 to 1; NaN where unknown.
    cut_off : bool, optional
        Whether the picture's border cuts it; None where unknown.
    distance_m : float
        Distance of its middle along the view, metres; NaN where unknown.
    centreline_m, thread_m, chord_m : float, optional
        True lengths, metres.
    axis_m : ndarray of float64, shape (K, 3), optional
        The true axis from blossom end to stem end, camera coordinates, metres.
    """

    box: NDArray[np.float64]
    code: Code | None = None
    keypoints: NDArray[np.float64] | None = None
    ignore: bool = False
    optional: bool = False
    hidden_share: float = math.nan
    cut_off: bool | None = None
    distance_m: float = math.nan
    centreline_m: float | None = None
    thread_m: float | None = None
    chord_m: float | None = None
    axis_m: NDArray[np.float64] | None = None

    @property
    def required(self) -> bool:
        """Whether it is to be found."""
        return not (self.ignore or self.optional)

    @property
    def long_px(self) -> float:
        """The longer side of its box, pixels."""
        return float(max(self.box[2] - self.box[0], self.box[3] - self.box[1]))


@dataclass(frozen=True, eq=False)
class FoundFruit:
    """Detection of a network.

    Parameters
    ----------
    box : ndarray of float64, shape (4,)
        Edges, pixels.
    score : float
        Its confidence.
    code : dict, optional
        Its mask, coded.
    keypoints : ndarray of float64, shape (5, 3), optional
        u, v in pixels and visibility 0 to 1.
    distance_m : float
        Distance along the view of what is in the middle of the box; NaN where unknown.
    """

    box: NDArray[np.float64]
    score: float
    code: Code | None = None
    keypoints: NDArray[np.float64] | None = None
    distance_m: float = math.nan

    @property
    def long_px(self) -> float:
        """The longer side of its box, pixels."""
        return float(max(self.box[2] - self.box[0], self.box[3] - self.box[1]))


@dataclass(frozen=True, eq=False)
class Frame:
    """One picture of the test.

    Parameters
    ----------
    name : str
        Its file's name, unique within the set.
    scene : str
        Pictures of one scene are no independent samples.
    width, height : int
        Its size, pixels.
    true : tuple of TrueFruit
        What is there.
    segmented, posed : tuple of FoundFruit
        What the two networks found, best first, whatever the confidence.
    kept : tuple of FoundFruit
        What a user gets at the confidence that is judged: fruit found twice made one.
    has_masks : bool
        Whether the first network draws masks at all.
    """

    name: str
    scene: str
    width: int
    height: int
    true: tuple[TrueFruit, ...] = ()
    segmented: tuple[FoundFruit, ...] = ()
    posed: tuple[FoundFruit, ...] = ()
    kept: tuple[FoundFruit, ...] = ()
    has_masks: bool = True

    def seen(self, stage: Stage) -> tuple[FoundFruit, ...]:
        """Return the detections of one stage."""
        return {
            Stage.SEGMENTED: self.segmented,
            Stage.POSED: self.posed,
            Stage.KEPT: self.kept,
        }[stage]


def code_mask(mask: NDArray[np.bool_]) -> Code:
    """Code a mask of shape (H, W).

    Examples
    --------
    >>> mask = np.zeros((4, 6), bool)
    >>> mask[1:3, 2:5] = True
    >>> code = code_mask(mask)
    >>> code["size"], code_overlap(code, code)
    ([4, 6], 1.0)
    """
    code: Code = import_pycocotools().encode(np.asfortranarray(mask, np.uint8))
    return code


def code_overlap(a: Code | None, b: Code | None) -> float:
    """Compute the intersection over union of two coded masks; 0 where one is missing or empty."""
    if a is None or b is None:
        return 0.0
    return float(import_pycocotools().iou([a], [b], [0])[0, 0])


def found_fruit_of(instance: Instance, depth_m: NDArray[np.float32] | None = None) -> FoundFruit:
    """Return what is judged of a detection, its mask coded (a full one takes a megabyte).

    Parameters
    ----------
    instance : Instance
        From a network.
    depth_m : ndarray of float32, shape (H, W), optional
        Metres, to tell its distance by: the median reading in the middle ninth of the box.
    """
    mask = instance.detector_mask
    code = None if mask is None else code_mask(mask)
    distance = math.nan if depth_m is None else _middle_depth(instance.box, depth_m)
    return FoundFruit(instance.box, instance.confidence, code, instance.keypoints, distance)


def _middle_depth(box: NDArray[np.float64], depth_m: NDArray[np.float32]) -> float:
    x1, y1, x2, y2 = box
    left, right = np.rint([(2 * x1 + x2) / 3, (x1 + 2 * x2) / 3]).astype(int)
    top, bottom = np.rint([(2 * y1 + y2) / 3, (y1 + 2 * y2) / 3]).astype(int)
    part = depth_m[max(top, 0) : bottom + 1, max(left, 0) : right + 1]
    read = part[valid_depth(part)]
    return float(np.median(read)) if read.size else math.nan


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
    """

    data: DataSet
    pictures: tuple[LabelledPicture, ...]


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
    return HeldOut(data, chosen)


def _file_fault(picture: LabelledPicture, data: DataSet) -> str:
    """Return what is wrong with a picture's files, in a few words; empty if nothing is."""
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
    """Return so many items, evenly spread over all.

    Examples
    --------
    >>> spread(("a", "b", "c", "d", "e"), 3)
    ('a', 'c', 'e')
    """
    if limit is None or limit >= len(items):
        return items
    return tuple(items[k] for k in np.linspace(0, len(items) - 1, limit).round().astype(int))


def frame_of(picture: LabelledPicture, data: DataSet, depth_m: NDArray[np.float32] | None) -> Frame:
    """Return a picture's truth as the evaluation takes it.

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
        axis_m=np.array(extras["axis_m"]) if "axis_m" in extras else None,
    )


def capture_of(picture: LabelledPicture, data: DataSet, color: NDArray[np.uint8]) -> Capture | None:
    """Return the RGB-D frame of a picture, or None where it has no depth or no camera.

    Raises
    ------
    CaptureError
        If its depth picture cannot be read or has another size.
    """
    if picture.depth_file is None or picture.camera is None:
        return None
    from cucumbervision.capture.depth import depth_to_metres
    from cucumbervision.capture.frames import Capture
    from cucumbervision.capture.pictures import read_depth

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
