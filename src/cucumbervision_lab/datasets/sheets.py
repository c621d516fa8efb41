"""Contact sheets: many pictures in one, each shrunk, so that fruit are small."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import cv2
import numpy as np

from cucumbervision.capture.files import read_color, write_jpeg
from cucumbervision.errors import DataSetError
from cucumbervision_lab.datasets.coco import write_coco
from cucumbervision_lab.datasets.labels import Label, LabelledPicture

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from numpy.typing import NDArray

    from cucumbervision_lab.datasets.labels import DataSet

__all__ = ["shrunk_label", "write_sheets"]

GRIDS = (2, 3)
LEAST_PX = 24
"""A fruit with fewer pixels than this is to be ignored."""


def shrunk_label(
    label: Label, scale: tuple[float, float], corner: tuple[int, int], side_px: int
) -> Label:
    """Give a label of a picture as it lies on a sheet.

    Parameters
    ----------
    label : Label
        Of the picture.
    scale : tuple of float
        Of the picture on the sheet, in x and y.
    corner : tuple of int
        x, y of its first pixel on the sheet.
    side_px : int
        Of the sheet.

    Returns
    -------
    Label
        In pixels of the sheet, without lengths; to be ignored where too little is left to see.

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
    moved = replace(label, box=box, keypoints=points, mask_code=None, amodal_code=None, extras={})
    if label.mask is None:
        return moved
    mask = _placed(label.mask, scale, corner, side_px)
    if np.count_nonzero(mask) < LEAST_PX:
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
    progress: Callable[[int], None] | None = None,
) -> DataSet:
    """Lay the pictures of a split out on sheets, two by two or three by three.

    Parameters
    ----------
    dataset : DataSet
        With masks, or boxes alone. Depth and cameras are left out.
    out : Path
        New folder.
    count : int
        How many sheets; every picture is used once before one comes again.
    side_px : int
        Of a sheet.
    split : str
        Whose pictures; sheets are to train on, or to validate.
    seed : int
        The same seed lays out the same sheets.
    progress : callable, optional
        Called with 1 after each sheet.

    Returns
    -------
    DataSet
        A sheet's scene is its own: its pictures are of many.

    Raises
    ------
    DataSetError
        If the split has no pictures, or a file cannot be written.
    CaptureError
        If a picture cannot be read.
    """
    pictures = dataset.in_split(split)
    if not pictures:
        raise DataSetError(f"has no pictures in {split}", source=dataset.folder, remedy="split it")
    rng = np.random.default_rng(seed)
    row: list[int] = []
    sheets = []
    sources = "; ".join(sorted({picture.source for picture in pictures}))
    licences = "; ".join(sorted({picture.licence for picture in pictures}))
    (out / "images").mkdir(parents=True, exist_ok=True)
    for number in range(count):
        grid = GRIDS[int(rng.integers(len(GRIDS)))]
        while len(row) < grid**2:
            row += rng.permutation(len(pictures)).tolist()
        chosen, row = [pictures[k] for k in row[: grid**2]], row[grid**2 :]
        color, labels = _laid_out(dataset, chosen, grid, side_px)
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
        if progress is not None:
            progress(1)
    return write_coco(replace(dataset, folder=out, pictures=tuple(sheets), refused=()), out)


def _laid_out(
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
