"""Training pictures at other scales: windows around fruit, and sheets of downscaled pictures.

For a fully convolutional network, a fruit looks the same in a 480 px window scaled to 320 px as in
the whole picture of 960 px scaled to 640 px. The window takes a quarter of the time and has no
letterbox borders. Sheets combine many downscaled pictures to provide small fruit.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import PurePosixPath
from typing import TYPE_CHECKING

import cv2
import numpy as np

from cucumbervision.capture.pictures import read_color, write_jpeg
from cucumbervision.errors import DataSetError
from cucumbervision.instances.boxes import share_inside
from cucumbervision.instances.mask_codes import Rle
from cucumbervision.instances.masks import box_of_mask
from cucumbervision_lab.datasets.coco import write_coco
from cucumbervision_lab.datasets.labels import Label, LabelledPicture, ticked

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from cucumbervision_lab.datasets.labels import DataSet

_MARGIN = 1.25  # minimum ratio of a window's side to the longer side of its fruit
_COMPLETE = 0.9  # share of a fruit inside a window above which it needs no other window
_LEAST_SHARE = 0.15  # share of a fruit inside a window below which it is ignored


@dataclass(frozen=True)
class Window:
    """A rectangular part of a picture.

    Parameters
    ----------
    left, top, width, height : int
        Position and size in pixels of the picture.
    """

    left: int
    top: int
    width: int
    height: int

    @property
    def slices(self) -> tuple[slice, slice]:
        """Row and column slices of the picture."""
        return (
            slice(self.top, self.top + self.height),
            slice(self.left, self.left + self.width),
        )


def choose_windows(
    rng: np.random.Generator, picture: LabelledPicture, side_px: int
) -> tuple[Window, ...]:
    """Choose random windows so that every fruit is complete in at least one.

    Parameters
    ----------
    rng : numpy.random.Generator
        Random generator.
    picture : LabelledPicture
        Picture with boxes.
    side_px : int
        Side of a window, pixels; larger if a fruit is larger.

    Returns
    -------
    tuple of Window
        Windows inside the picture; a single one if there is no fruit.

    Examples
    --------
    >>> from cucumbervision_lab.datasets.labels import Label, LabelledPicture
    >>> fruit = tuple(Label(np.array([x, 10.0, x + 40, 30.0])) for x in (10.0, 60.0, 400.0))
    >>> picture = LabelledPicture("a.png", 480, 270, fruit)
    >>> windows = choose_windows(np.random.default_rng(1), picture, 128)
    >>> len(windows), {(w.width, w.height) for w in windows}
    (2, {(128, 128)})
    """
    boxes = [label.box for label in picture.labels if not label.ignore]
    if not boxes:
        return (_around(rng, picture, np.full(4, np.nan), side_px),)
    chosen: list[Window] = []
    for index in rng.permutation(len(boxes)):
        if not any(_inside(boxes[index], window) >= _COMPLETE for window in chosen):
            chosen.append(_around(rng, picture, boxes[index], side_px))
    return tuple(chosen)


def _around(
    rng: np.random.Generator, picture: LabelledPicture, box: NDArray[np.float64], side_px: int
) -> Window:
    """Place a random window that contains a box, or anywhere if the box is NaN."""
    placed = []
    long_px = 0.0 if np.isnan(box[0]) else float(max(box[2] - box[0], box[3] - box[1]))
    side = max(side_px, round(_MARGIN * long_px))
    for axis, length in enumerate((picture.width, picture.height)):
        size = min(side, length)
        first, last = 0, length - size
        if not np.isnan(box[0]):
            first = max(first, int(np.ceil(box[2 + axis] + 0.5)) - size)
            last = min(last, int(np.floor(box[axis] + 0.5)))
        placed.append((int(rng.integers(first, max(first, last) + 1)), size))
    (column, width), (top, height) = placed
    return Window(column, top, width, height)


def _inside(box: NDArray[np.float64], window: Window) -> float:
    """Return the share of a box inside a window."""
    edges = [window.left, window.top, window.left + window.width, window.top + window.height]
    return float(share_inside(box[None], np.array([edges]) - 0.5)[0])


def crop_label(label: Label, window: Window) -> Label | None:
    """Crop a label to a window.

    Parameters
    ----------
    label : Label
        Label of the whole picture.
    window : Window
        Part of that picture.

    Returns
    -------
    Label or None
        Label in pixels of the window; None if the fruit is outside. Keypoints outside become
        unlabelled. A fruit with a share below 0.15 inside the window is ignored. A cropped fruit is
        `cut_off` and loses its lengths.

    Examples
    --------
    >>> mask = np.zeros((20, 40), bool)
    >>> mask[5:10, 10:30] = True
    >>> cut = crop_label(Label.of_mask(mask), Window(20, 0, 20, 20))
    >>> cut.box.tolist(), cut.cut_off, cut.ignore
    ([-0.5, 4.5, 9.5, 9.5], True, False)
    """
    share = inside = _inside(label.box, window)
    part = amodal_part = None
    cut = label.cut_off or inside < 1
    if (mask := label.mask) is not None:
        part = mask[window.slices]
        share = float(part.sum() / max(mask.sum(), 1))
    if share == 0:
        return None
    if (amodal := label.amodal) is not None:
        amodal_part = amodal[window.slices]
        cut = cut or bool(amodal_part.sum() < amodal.sum())
    limit = np.array([window.width - 0.5, window.height - 0.5])
    moved = (label.box.reshape(2, 2) - (window.left, window.top)).clip(-0.5, limit).ravel()
    return replace(
        label,
        box=moved if part is None else box_of_mask(part),
        mask_code=None if part is None else Rle.of(part),
        amodal_code=None if amodal_part is None else Rle.of(amodal_part),
        keypoints=_crop_keypoints(label.keypoints, window),
        cut_off=cut,
        ignore=label.ignore or share < _LEAST_SHARE,
        extras=label.point_order if cut else label.extras,
    )


def _crop_keypoints(
    keypoints: NDArray[np.float64] | None, window: Window
) -> NDArray[np.float64] | None:
    if keypoints is None:
        return None
    points = keypoints - (window.left, window.top, 0.0)
    size = np.array([window.width, window.height])
    outside = ((points[:, :2] < -0.5) | (points[:, :2] > size - 0.5)).any(axis=1)
    points[outside] = 0.0
    return points


def write_windows(
    dataset: DataSet,
    out: Path,
    side_px: int,
    *,
    splits: Sequence[str] = ("train",),
    seed: int = 0,
    progress: Callable[[int], None] | None = None,
) -> DataSet:
    """Cut windows around fruit and write them as a new data set.

    Parameters
    ----------
    dataset : DataSet
        Data set with boxes and optional masks and keypoints. Depth and cameras are dropped.
    out : Path
        New output folder.
    side_px : int
        Side of a window, pixels.
    splits : sequence of str
        Splits to use. Windows are for training, not for testing.
    seed : int
        Random seed.
    progress : callable, optional
        Called with 1 after each picture.

    Returns
    -------
    DataSet
        Windows with the scene, source and licence of their pictures.

    Raises
    ------
    DataSetError
        If `side_px` is below 32, or a file cannot be written.
    CaptureError
        If a picture cannot be read.
    """
    if side_px < 32:
        raise DataSetError(f"a window of {side_px} px is too small", remedy="use 32 px or more")
    pictures: list[LabelledPicture] = []
    for index, picture in enumerate(ticked(dataset.pictures, progress)):
        if picture.split in splits:
            rng = np.random.default_rng([seed, index])
            pictures += _cut(dataset, picture, choose_windows(rng, picture, side_px), out)
    return write_coco(replace(dataset, folder=out, pictures=tuple(pictures)), out)


def _cut(
    dataset: DataSet, picture: LabelledPicture, windows: Sequence[Window], out: Path
) -> Iterator[LabelledPicture]:
    color = read_color(dataset.path(picture))
    path = PurePosixPath(picture.file)
    for number, window in enumerate(windows):
        file = path.with_name(f"{path.stem}-w{number}.jpg")
        (out / file).parent.mkdir(parents=True, exist_ok=True)
        write_jpeg(out / file, color[window.slices])
        labels = (crop_label(label, window) for label in picture.labels)
        yield replace(
            picture,
            file=str(file),
            width=window.width,
            height=window.height,
            labels=tuple(label for label in labels if label is not None),
            depth_file=None,
            camera=None,
            extras={},
        )


_GRIDS = (2, 3)
_LEAST_PX = 24
"""Fruit with fewer pixels than this are ignored."""


def shrunk_label(
    label: Label, scale: tuple[float, float], corner: tuple[int, int], side_px: int
) -> Label:
    """Transform a label from a picture to a sheet.

    Parameters
    ----------
    label : Label
        Label of the picture.
    scale : tuple of float
        Scale of the picture on the sheet in x and y.
    corner : tuple of int
        x, y of the picture's first pixel on the sheet.
    side_px : int
        Side of the sheet, pixels.

    Returns
    -------
    Label
        Label in pixels of the sheet without lengths; ignored if the fruit is too small.

    Examples
    --------
    >>> mask = np.zeros((40, 80), bool)
    >>> mask[10:20, 20:60] = True
    >>> shrunk_label(Label.of_mask(mask), (0.5, 0.5), (100, 0), 200).box.tolist()
    [109.5, 4.5, 129.5, 9.5]
    """
    shift = np.array(corner, np.float64)
    box = ((label.box.reshape(2, 2) + 0.5) * scale + shift - 0.5).ravel()
    points = label.keypoints
    if points is not None:
        places = (points[:, :2] + 0.5) * scale + shift - 0.5
        points = np.column_stack([places, points[:, 2]])
    moved = replace(
        label,
        box=box,
        keypoints=points,
        mask_code=None,
        amodal_code=None,
        extras=label.point_order,
    )
    if label.mask is None:
        return moved
    mask = _placed(label.mask, scale, corner, side_px)
    if np.count_nonzero(mask) < _LEAST_PX:
        return replace(moved, ignore=True)
    fresh = Label.of_mask(mask)
    return replace(moved, box=fresh.box, mask_code=fresh.mask_code)


def _placed(
    mask: NDArray[np.bool_], scale: tuple[float, float], corner: tuple[int, int], side_px: int
) -> NDArray[np.bool_]:
    height, width = mask.shape
    size = round(width * scale[0]), round(height * scale[1])
    small = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.5
    sheet = np.zeros((side_px, side_px), bool)
    x, y = corner
    sheet[y : y + size[1], x : x + size[0]] = small[: side_px - y, : side_px - x]
    return sheet


def write_sheets(
    dataset: DataSet,
    out: Path,
    count: int,
    side_px: int = 896,
    *,
    split: str = "train",
    seed: int = 0,
) -> DataSet:
    """Combine downscaled pictures of a split into sheets of 2 x 2 or 3 x 3.

    Parameters
    ----------
    dataset : DataSet
        Data set with masks or boxes. Depth and cameras are dropped.
    out : Path
        New output folder.
    count : int
        Number of sheets. Every picture is used once before any is repeated.
    side_px : int
        Side of a sheet, pixels.
    split : str
        Split to use.
    seed : int
        Random seed.

    Returns
    -------
    DataSet
        Sheets, each with a scene of its own.

    Raises
    ------
    DataSetError
        If the split has no pictures, or a file cannot be written.
    CaptureError
        If a picture cannot be read.
    """
    pictures = dataset.in_split(split)
    if not pictures:
        raise DataSetError(
            f"has no pictures in {split}", source=dataset.folder, remedy="split the data set"
        )
    rng = np.random.default_rng(seed)
    row: list[int] = []
    sheets = []
    sources = "; ".join(sorted({picture.source for picture in pictures}))
    licences = "; ".join(sorted({picture.licence for picture in pictures}))
    (out / "images").mkdir(parents=True, exist_ok=True)
    for number in range(count):
        grid = _GRIDS[int(rng.integers(len(_GRIDS)))]
        while len(row) < grid**2:
            row += rng.permutation(len(pictures)).tolist()
        chosen, row = [pictures[k] for k in row[: grid**2]], row[grid**2 :]
        color, labels = _compose_sheet(dataset, chosen, grid, side_px)
        file = f"images/{split}-{number:05d}.jpg"
        write_jpeg(out / file, color)
        sheets.append(
            LabelledPicture(
                file,
                side_px,
                side_px,
                tuple(labels),
                scene=f"sheet-{split}-{number:05d}",
                split=split,
                source=sources,
                licence=licences,
            )
        )
    return write_coco(replace(dataset, folder=out, pictures=tuple(sheets), refused=()), out)


def _compose_sheet(
    dataset: DataSet, chosen: list[LabelledPicture], grid: int, side_px: int
) -> tuple[NDArray[np.uint8], list[Label]]:
    cell = side_px // grid
    sheet = np.full((side_px, side_px, 3), 114, np.uint8)
    labels: list[Label] = []
    for place, picture in enumerate(chosen):
        color = read_color(dataset.path(picture))
        share = cell / max(picture.width, picture.height)
        width, height = round(picture.width * share), round(picture.height * share)
        x, y = (place % grid) * cell, (place // grid) * cell
        small = cv2.resize(color, (width, height), interpolation=cv2.INTER_AREA)
        sheet[y : y + height, x : x + width] = small
        scale = width / picture.width, height / picture.height
        labels += [shrunk_label(label, scale, (x, y), side_px) for label in picture.labels]
    return sheet, labels
