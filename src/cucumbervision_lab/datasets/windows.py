"""Windows around fruit: small pictures that hold what large ones are trained for.

A network without fully connected layers sees a fruit in a window of 480 pixels, scaled to 320,
just as in the whole picture of 960 scaled to 640; the window costs a quarter of the time, and grey
borders and empty corners cost none.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import PurePosixPath
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.capture.files import read_color, write_jpeg
from cucumbervision.errors import DataSetError
from cucumbervision.perception.masks import Rle, box_of_mask
from cucumbervision_lab.datasets.coco import write_coco

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from cucumbervision_lab.datasets.labels import DataSet, Label, LabelledPicture

__all__ = ["Window", "choose_windows", "label_in", "write_windows"]

MARGIN = 1.25  # a window's side over the longer side of the fruit that it is cut around
WHOLE = 0.9  # of a fruit's pixels in a window: another one of its own is not needed
SLIVER = 0.15  # with less of its pixels a fruit in a window is to be ignored


@dataclass(frozen=True)
class Window:
    """A part of a picture.

    Parameters
    ----------
    left, top, width, height : int
        In pixels of the picture.
    """

    left: int
    top: int
    width: int
    height: int

    @property
    def slices(self) -> tuple[slice, slice]:
        """Rows and columns of the picture."""
        return (
            slice(self.top, self.top + self.height),
            slice(self.left, self.left + self.width),
        )


def choose_windows(
    rng: np.random.Generator, picture: LabelledPicture, side_px: int
) -> tuple[Window, ...]:
    """Choose windows in which every fruit of a picture lies whole at least once.

    Parameters
    ----------
    rng : numpy.random.Generator
        The source of chance.
    picture : LabelledPicture
        With boxes.
    side_px : int
        Side of a window, pixels; larger where a fruit is.

    Returns
    -------
    tuple of Window
        One where there is no fruit. None reaches beyond the picture.

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
        if not any(_inside(boxes[index], window) >= WHOLE for window in chosen):
            chosen.append(_around(rng, picture, boxes[index], side_px))
    return tuple(chosen)


def _around(
    rng: np.random.Generator, picture: LabelledPicture, box: NDArray[np.float64], side_px: int
) -> Window:
    """Put a window somewhere about a box, or anywhere."""
    placed = []
    long_px = 0.0 if np.isnan(box[0]) else float(max(box[2] - box[0], box[3] - box[1]))
    side = max(side_px, round(MARGIN * long_px))
    for axis, whole in enumerate((picture.width, picture.height)):
        size = min(side, whole)
        first, last = 0, whole - size
        if not np.isnan(box[0]):
            first = max(first, int(np.ceil(box[2 + axis] + 0.5)) - size)
            last = min(last, int(np.floor(box[axis] + 0.5)))
        placed.append((int(rng.integers(first, max(first, last) + 1)), size))
    (left, width), (top, height) = placed
    return Window(left, top, width, height)


def _inside(box: NDArray[np.float64], window: Window) -> float:
    """Give the share of a box that lies in a window."""
    edges = box + 0.5
    low = np.maximum(edges[:2], (window.left, window.top))
    high = np.minimum(edges[2:], (window.left + window.width, window.top + window.height))
    return float(np.maximum(high - low, 0).prod() / max((edges[2:] - edges[:2]).prod(), 1e-9))


def label_in(label: Label, window: Window) -> Label | None:
    """Give a label as a window shows it, or None where it shows nothing of the fruit.

    Parameters
    ----------
    label : Label
        Of the picture.
    window : Window
        Part of that picture.

    Returns
    -------
    Label or None
        In pixels of the window. Points outside are not labelled any more. A fruit of which less
        than 0.15 is left is to be ignored; one of which something is left out is cut off, and
        loses its lengths.

    Examples
    --------
    >>> from cucumbervision_lab.datasets.labels import Label
    >>> mask = np.zeros((20, 40), bool)
    >>> mask[5:10, 10:30] = True
    >>> cut = label_in(Label.of_mask(mask), Window(20, 0, 20, 20))
    >>> cut.box.tolist(), cut.cut_off, cut.ignore
    ([-0.5, 4.5, 9.5, 9.5], True, False)
    """
    mask, amodal = label.mask, label.amodal
    part = None if mask is None else mask[window.slices]
    if part is not None and mask is not None:
        share = float(np.count_nonzero(part)) / max(int(np.count_nonzero(mask)), 1)
    else:
        share = _inside(label.box, window)
    if share == 0:
        return None
    whole_part = None if amodal is None else amodal[window.slices]
    cut = label.cut_off or _inside(label.box, window) < 1
    if whole_part is not None and amodal is not None:
        cut = cut or int(np.count_nonzero(whole_part)) < int(np.count_nonzero(amodal))
    high = np.array([window.width - 0.5, window.height - 0.5])
    moved = (label.box.reshape(2, 2) - (window.left, window.top)).clip(-0.5, high).ravel()
    return replace(
        label,
        box=moved if part is None else box_of_mask(part),
        mask_code=None if part is None else Rle.of(part),
        amodal_code=None if whole_part is None else Rle.of(whole_part),
        keypoints=_points_in(label.keypoints, window),
        cut_off=cut,
        ignore=label.ignore or share < SLIVER,
        extras={} if cut else label.extras,
    )


def _points_in(keypoints: NDArray[np.float64] | None, window: Window) -> NDArray[np.float64] | None:
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
    """Cut windows around the fruit of a set and write them as a set of their own.

    Parameters
    ----------
    dataset : DataSet
        With boxes, and masks and keypoints where there are some. Depth and cameras are left out.
    out : Path
        New folder.
    side_px : int
        Side of a window, pixels.
    splits : sequence of str
        Whose pictures are cut; windows are to train on, and nothing is tested on them.
    seed : int
        The same seed cuts the same windows.
    progress : callable, optional
        Called with 1 after each picture.

    Returns
    -------
    DataSet
        A window's scene, source and licence are its picture's.

    Raises
    ------
    DataSetError
        If the side is under 32 pixels, or a file cannot be written.
    CaptureError
        If a picture cannot be read.
    """
    if side_px < 32:
        raise DataSetError(f"a window of {side_px} px is too small", remedy="give 32 or more")
    pictures: list[LabelledPicture] = []
    for index, picture in enumerate(dataset.pictures):
        if picture.split in splits:
            rng = np.random.default_rng([seed, index])
            pictures += _cut(dataset, picture, choose_windows(rng, picture, side_px), out)
        if progress is not None:
            progress(1)
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
        labels = (label_in(label, window) for label in picture.labels)
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
