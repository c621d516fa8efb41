"""Crops around the ends of drawn fruit, to train and to judge the network that looks at them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cucumbervision.capture.frames import Capture, valid_depth
from cucumbervision.capture.pictures import read_color
from cucumbervision.errors import TrainingError
from cucumbervision.fruit.crops import end_crop
from cucumbervision.tube.shape import arc_positions, points_along
from cucumbervision_lab.arrays import Array, Array32, Generator, Mask, Pixels, Progress
from cucumbervision_lab.data.splits import is_held_out
from cucumbervision_lab.evaluate.pictures import capture_of
from cucumbervision_lab.scenes.covers import FruitPicture, cover_end
from cucumbervision_lab.train.fruit_crops import Crops
from cucumbervision_lab.train.measured_ends import (
    HELD_OUT,
    camera_of,
    labelled_fruit,
    measured_fruit,
)

if TYPE_CHECKING:
    from cucumbervision_lab.data.labels import DataSet, LabelledPicture
    from cucumbervision_lab.scenes.paste import Cutout
    from cucumbervision_lab.train.measured_ends import EndTruth, MeasuredFruit

MISSING = 0.05
"""Share of a fruit's length from which an end counts as covered, or as running on."""

_TRUE_END = 0.03  # of the length: an end that lies no farther off is covered from there
_END_OFF = 0.2  # radii by which a covered end errs (standard deviation)
_LEAST_RADIUS_PX, _AROUND_RADII = 4.0, 7.0  # of fruit whose ends are covered; the part around them
_MOVED_SD = 0.7  # radii that a further copy of each end of training is moved along the axis


@dataclass(frozen=True, eq=False)
class EndCrops(Crops):
    """Crops around the ends of measured fruit.

    Parameters
    ----------
    planes : ndarray of uint8, shape (N, 64, 64, 6)
        As `EndCrop.planes`.
    shapes : ndarray of float32, shape (N, 2)
        As `EndCrop.shape`.
    missing : ndarray of float32, shape (N,)
        Share of the true length that is missing there; negative where too much was measured; NaN
        where it is not known.
    covered : ndarray of float32, shape (N,)
        Whether the end is covered or cut, where only that is known; NaN elsewhere.
    stem : ndarray of float32, shape (N,)
        Whether it is the stem end; NaN where that is not known.
    fruit : ndarray of int64, shape (N,)
        Number of the fruit among those that were given.
    moved : ndarray of bool, shape (N,)
        Whether it is a copy that was moved along the axis.
    held_out : ndarray of bool, shape (N,)
        Whether its scene is not trained on.
    """

    planes: Pixels
    shapes: Array32
    missing: Array32
    covered: Array32
    stem: Array32
    fruit: NDArray[np.int64]
    moved: Mask
    held_out: Mask

    @property
    def state(self) -> NDArray[np.int64]:
        """Index into `STATES`; -1 where it is not known."""
        by_length = np.where(self.missing > MISSING, 1, np.where(self.missing < -MISSING, 2, 0))
        by_eye = np.where(np.isnan(self.covered), -1, np.where(self.covered > 0.5, 1, 0))
        return np.where(np.isnan(self.missing), by_eye, by_length).astype(np.int64)

    @classmethod
    def joined(cls, parts: Sequence[EndCrops]) -> EndCrops:
        """Return the crops of several sets as one; fruit are numbered on."""
        first = np.cumsum([0, *(int(part.fruit.max(initial=-1)) + 1 for part in parts)])
        fruit = [part.fruit + k for part, k in zip(parts, first, strict=False)]
        numbered = zip(parts, fruit, strict=True)
        return cls.stacked([replace(part, fruit=numbers) for part, numbers in numbered])


def moved_axis(axis_m: Array, by_m: float) -> Array:
    """Return an axis with its first end moved along it, outward where positive.

    Examples
    --------
    >>> axis = np.stack([np.linspace(0, 0.1, 11), np.zeros(11), np.ones(11)], axis=1)
    >>> [round(float(moved_axis(axis, by)[0, 0]), 3) for by in (0.02, -0.02)]
    [-0.02, 0.02]
    """
    run = arc_positions(axis_m)
    if by_m < 0:
        return points_along(axis_m, np.linspace(min(-by_m / run[-1], 0.9), 1, len(axis_m)))
    out = axis_m[0] - axis_m[1]
    tip = axis_m[0] + by_m * out / max(float(np.linalg.norm(out)), 1e-9)
    return np.vstack([tip, axis_m[1:]])


def collect_end_crops(fruit: Sequence[MeasuredFruit], data: DataSet, seed: int = 0) -> EndCrops:
    """Cut out both ends of fruit, and of those of training each once more, moved along the axis.

    Parameters
    ----------
    fruit : sequence of MeasuredFruit
        Of `measured_fruit`, those of a picture one after the other.
    data : DataSet
        Their set.
    seed : int
        Random seed of the moves.

    Raises
    ------
    TrainingError
        If there are no fruit.
    CaptureError
        If a picture cannot be read.
    """
    pictures = {picture.file: picture for picture in data.pictures}
    rng, rows = np.random.default_rng(seed), []
    numbered = list(enumerate(fruit))
    of_pictures = [list(group) for _, group in groupby(numbered, lambda entry: entry[1].picture)]
    for of_picture in of_pictures:
        picture = pictures[of_picture[0][1].picture]
        color = read_color(data.path(picture))
        capture = capture_of(picture, data, color) or _without_depth(picture, color)
        for number, measured in of_picture:
            rows += _crops_of(number, measured, capture, rng)
    if not rows:
        raise TrainingError(
            "no measured fruit", source=data.folder, remedy="give a drawn set with depth"
        )
    return _of_rows(rows)


def _of_rows(rows: Sequence[tuple[Any, ...]]) -> EndCrops:
    planes, shapes, missing, stem, numbers, moved, held = zip(*rows, strict=True)
    count = len(rows)
    return EndCrops(
        np.stack(planes),
        np.array(shapes, np.float32),
        np.array(missing, np.float32),
        np.full(count, np.nan, np.float32),
        np.array(stem, np.float32),
        np.array(numbers),
        np.array(moved),
        np.array(held),
    )


def collect_covered_ends(
    fruit: Sequence[MeasuredFruit], data: DataSet, pieces: Sequence[Cutout], seed: int = 0
) -> EndCrops | None:
    """Cut out true ends of training over, beside or behind which real leaves or stems were laid.

    Parameters
    ----------
    fruit : sequence of MeasuredFruit
        Of `labelled_fruit`, those of a picture one after the other.
    data : DataSet
        Their set.
    pieces : sequence of Cutout
        Leaves (`read_pieces`).
    seed : int
        Random seed.

    Returns
    -------
    EndCrops or None
        None without an end to lay anything over.

    Raises
    ------
    CaptureError
        If a picture cannot be read.
    """
    pictures = {picture.file: picture for picture in data.pictures}
    rng, rows = np.random.default_rng(seed), []
    learnt = [
        (number, measured)
        for number, measured in enumerate(fruit)
        if not (measured.cut or measured.held_out)
    ]
    for file, group in groupby(learnt, lambda entry: entry[1].picture):
        color = read_color(data.path(pictures[file]))
        capture = capture_of(pictures[file], data, color) or _without_depth(pictures[file], color)
        for number, measured in group:
            axis = np.array(measured.axis_m)
            for line, end in ((axis, measured.ends[0]), (axis[::-1], measured.ends[1])):
                if abs(end.missing_m) <= _TRUE_END * measured.true_m[0]:
                    row = _covered_row(number, measured, line, end, capture, pieces, rng)
                    rows += [] if row is None else [row]
    return _of_rows(rows) if rows else None


def _covered_row(
    number: int,
    fruit: MeasuredFruit,
    line_m: Array,
    end: EndTruth,
    capture: Capture,
    pieces: Sequence[Cutout],
    rng: Generator,
) -> tuple[Any, ...] | None:
    mask, radius_m = fruit.mask.decode(), fruit.diameter_m / 2
    radius_px = radius_m * capture.intrinsics.fx_px / float(line_m[0, 2])
    if radius_px < _LEAST_RADIUS_PX:
        return None
    axis_px = capture.intrinsics.project(line_m)
    margin = _AROUND_RADII * radius_px
    x1, y1 = np.maximum(axis_px.min(axis=0) - margin, 0).astype(int)
    x2, y2 = (axis_px.max(axis=0) + margin + 1).astype(int)
    part = np.s_[y1:y2, x1:x2]
    has_depth = bool(valid_depth(capture.depth_m).any())
    covered = cover_end(
        FruitPicture(capture.color[part], capture.depth_m[part], mask[part]),
        axis_px - (x1, y1),
        radius_px,
        pieces,
        rng,
        surface_m=float(line_m[min(4, len(line_m) - 1), 2]) - radius_m if has_depth else 0.0,
        radius_m=radius_m,
    )
    if covered is None:
        return None
    picture, share = covered
    color, depth_m, visible = capture.color.copy(), capture.depth_m.copy(), np.zeros_like(mask)
    color[part], depth_m[part], visible[part] = picture.color, picture.depth_m, picture.mask
    by_m = float(rng.normal(0, _END_OFF)) * radius_m
    axis_m = moved_axis(points_along(line_m, np.linspace(share, 1, len(line_m))), by_m)
    crop = end_crop(color, depth_m, visible, capture.intrinsics, axis_m, fruit.diameter_m)
    lost_m = share * float(arc_positions(line_m)[-1])
    missing = (end.missing_m + lost_m - by_m) / fruit.true_m[0]
    stem = np.nan if end.is_stem is None else float(end.is_stem)
    return crop.planes, crop.shape, missing, stem, number, False, False


def _without_depth(picture: LabelledPicture, color: Pixels) -> Capture:
    return Capture(color, np.zeros(color.shape[:2], np.float32), camera_of(picture), picture.file)


def collect_set(
    data: DataSet,
    keep: Path,
    seed: int = 0,
    progress: Progress | None = None,
    pieces: Sequence[Cutout] = (),
) -> tuple[list[MeasuredFruit], EndCrops]:
    """Measure the fruit of a drawn set, and cut out their ends.

    Those to train on, and those without depth, are cut from the labels too.

    Parameters
    ----------
    data : DataSet
        A set by `cucumbervision synth` with depth; or without, of real fruit pasted into photos,
        which are not measured.
    keep : Path
        The file of what is measured (`measured_fruit`).
    seed : int
        Random seed of the labels' errors and of the moves.
    progress : callable, optional
        Called with 1 after each picture that was measured.
    pieces : sequence of Cutout
        Leaves to lay over, beside and behind ends to train on.

    Returns
    -------
    fruit : list of MeasuredFruit
        The fruit, as the crops number them.
    crops : EndCrops
        Their ends.

    Raises
    ------
    TrainingError, CaptureError
        As `collect_end_crops`.
    """
    measured = measured_fruit(data, keep, progress)
    rng = np.random.default_rng(seed)
    by_label = [
        picture
        for picture in data.pictures
        if picture.depth_file is None or not is_held_out(picture, HELD_OUT)
    ]
    fruit = [labelled for picture in by_label for labelled in labelled_fruit(picture, rng)]
    covered = collect_covered_ends(fruit, data, pieces, seed) if pieces else None
    fruit += measured
    crops = collect_end_crops(fruit, data, seed)
    return fruit, crops if covered is None else EndCrops.stacked([crops, covered])


def _crops_of(
    number: int, fruit: MeasuredFruit, capture: Capture, rng: Generator
) -> list[tuple[Any, ...]]:
    axis, mask = np.array(fruit.axis_m), fruit.mask.decode()
    held, rows = fruit.held_out, []
    for line, end in ((axis, fruit.ends[0]), (axis[::-1], fruit.ends[1])):
        moves = (0.0,) if held else (0.0, float(rng.normal(0, _MOVED_SD)) * fruit.diameter_m / 2)
        for by_m in moves:
            crop = end_crop(
                capture.color,
                capture.depth_m,
                mask,
                capture.intrinsics,
                moved_axis(line, by_m) if by_m else line,
                fruit.diameter_m,
            )
            missing = (end.missing_m - by_m) / fruit.true_m[0]
            stem = np.nan if end.is_stem is None else float(end.is_stem)
            rows.append((crop.planes, crop.shape, missing, stem, number, by_m != 0, held))
    return rows
