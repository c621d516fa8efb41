"""Fruit of drawn scenes as M6 measures them, and crops around their ends to train a network on."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import lru_cache, partial
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter
from scipy.spatial import cKDTree

from cucumbervision.capture.frames import Capture, valid_depth
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.capture.pictures import read_color
from cucumbervision.errors import TrainingError
from cucumbervision.fruit.crops import END_PX, PLANES, end_crop
from cucumbervision.fruit.instance import Instance, MaskSource
from cucumbervision.fruit.mask_codes import Rle
from cucumbervision.fruit.masks import box_ious, distances_inside, mask_pixels
from cucumbervision.methods.intervals import mask_features, tube_features
from cucumbervision.methods.result import Fruit, MethodName
from cucumbervision.methods.selector import measure_fruit
from cucumbervision.networks.keypoint_axis import axis_line
from cucumbervision.run.measurer import Measurer
from cucumbervision.run.options import MeasureOptions
from cucumbervision.tube.shape import arc_positions, points_along
from cucumbervision_lab.arrays import Array, Generator, Mask, Progress
from cucumbervision_lab.data.labels import DataSet, Label, LabelledPicture
from cucumbervision_lab.data.splits import is_held_out
from cucumbervision_lab.evaluate.pictures import capture_of
from cucumbervision_lab.processes import kept_rows
from cucumbervision_lab.scenes.covers import FruitPicture, cover_end
from cucumbervision_lab.scenes.paste import Cutout
from cucumbervision_lab.train.fruit_crops import Crops, crops_of

AXIS_POINTS = 33

HELD_OUT = 2
"""One of so many scenes is not trained on: ends are judged and intervals learnt on these."""

_FOUND_IOU = 0.5
_LEAST_SEEN = 12  # pixels of the visible mask
_FINE = 201  # points of a true axis that mask pixels are assigned to
_EDGE_SHARE = 0.002  # of the mask's pixels, beyond either end: specks
_LEAST_SPAN = 0.05  # of the axis
_PASTED_AT_M = 0.5  # any distance: nothing of a photo is measured in metres
_LEAST_ASPECT = 3.0  # length over radius of a pasted fruit
_END_SD, _GIRTH_SD = 0.25, 0.06  # errors: of an end, in radii; of the girth, relative


@dataclass(frozen=True, kw_only=True)
class MeasuredFruit:
    """One fruit of a drawn picture, measured by M6.

    Parameters
    ----------
    picture : str
        The picture's file.
    given : bool
        Whether the mask is the label's; otherwise the networks drew it.
    mask : Rle
        The mask that was measured.
    axis_m : tuple of tuple of float
        `AXIS_POINTS` points of the fitted axis, camera coordinates, metres.
    diameter_m : float
        Largest diameter, metres.
    lengths_m, true_m : tuple of float
        Centreline, thread and chord as measured, and true.
    missing_m : tuple of float
        How far the true end lies beyond the first and the last point of the axis, along the true
        axis, metres; negative where the measured end lies beyond the fruit.
    stem_first : bool, optional
        Whether the stem end is the first; None where that is not known.
    hidden_share : float
        Occluded share of the fruit, 0 to 1.
    cut : bool
        Whether the fruit goes on beyond the picture.
    held_out : bool
        Whether it is not trained on.
    features : dict of str to float
        Of the interval model.
    """

    picture: str
    mask: Rle
    axis_m: tuple[tuple[float, ...], ...]
    diameter_m: float
    lengths_m: tuple[float, float, float]
    true_m: tuple[float, float, float]
    missing_m: tuple[float, float]
    stem_first: bool | None
    given: bool = True
    hidden_share: float = 0.0
    cut: bool = False
    held_out: bool = False
    features: Mapping[str, float] = field(default_factory=dict)

    def ends(self) -> Iterator[tuple[Array, float, float]]:
        """Yield the axis from either end, what is missing there, and 1 for the stem end or NaN."""
        axis, unknown = np.array(self.axis_m), self.stem_first is None
        yield axis, self.missing_m[0], np.nan if unknown else float(self.stem_first or 0.0)
        yield axis[::-1], self.missing_m[1], np.nan if unknown else float(not self.stem_first)


def end_truths(axis_m: Array, true_m: Array) -> tuple[tuple[float, float], bool]:
    """Return what is missing at both ends of a measured axis, and whether the stem end is first.

    Parameters
    ----------
    axis_m : ndarray of float64, shape (K, 3)
        The measured axis.
    true_m : ndarray of float64, shape (T, 3)
        The true axis from the blossom end to the stem end.

    Examples
    --------
    A fruit of 20 cm, measured from its stem end to 3 cm before the blossom end, 1 cm too far there:

    >>> true = np.stack([np.linspace(0, 0.2, 41), np.zeros(41), np.full(41, 0.5)], axis=1)
    >>> axis = np.stack([np.linspace(0.21, 0.03, 9), np.zeros(9), np.full(9, 0.51)], axis=1)
    >>> end_truths(axis, true)
    ((-0.01, 0.03), True)
    """
    run = arc_positions(true_m)
    first, last = (_place_along(true_m, run, tip) for tip in (axis_m[0], axis_m[-1]))
    stem_first, length = first > last, float(run[-1])
    missing = (length - first, last) if stem_first else (first, length - last)
    return (round(missing[0], 5), round(missing[1], 5)), stem_first


def _place_along(line_m: Array, run: Array, point: Array) -> float:
    """Return how far along a line, prolonged straight at its ends, a point lies."""
    nearest = int(np.linalg.norm(line_m - point, axis=1).argmin())
    before, after = max(nearest - 1, 0), min(nearest + 1, len(line_m) - 1)
    ahead = line_m[after] - line_m[before]
    ahead = ahead / max(float(np.linalg.norm(ahead)), 1e-9)
    return float(run[nearest] + (point - line_m[nearest]) @ ahead)


def labelled_fruit(picture: LabelledPicture, rng: Generator) -> list[MeasuredFruit]:
    """Return the fruit of a picture as far as their labels' masks show them, unmeasured.

    Cut from the labels, which costs a hundredth of measuring; ends and girth err at random about as
    M6's do. A real fruit that was pasted into a photo has no depth: its axis is that of its whole
    outline, half a metre away, and its stem end is not known.

    Parameters
    ----------
    picture : LabelledPicture
        With the fruit's true axes, or with their whole outlines.
    rng : Generator
        Of the errors.
    """
    camera, fruit_list = camera_of(picture), []
    for label in picture.labels:
        mask = label.mask
        if label.ignore or mask is None or np.count_nonzero(mask) < _LEAST_SEEN:
            continue
        body = _drawn_body(label) or _pasted_body(label, camera)
        if body is None:
            continue
        line = points_along(body.axis_m, np.linspace(0, 1, _FINE))
        nearest = cKDTree(camera.project(line)).query(mask_pixels(mask))[1]
        shares = np.quantile(nearest, (_EDGE_SHARE, 1 - _EDGE_SHARE)) / (_FINE - 1)
        if shares[1] - shares[0] < _LEAST_SPAN:
            continue
        axis = points_along(body.axis_m, np.linspace(shares[0], shares[1], AXIS_POINTS))
        for tip, inner in ((0, 1), (-1, -2)):
            out = axis[tip] - axis[inner]
            off_m = rng.normal(0, _END_SD) * body.radius_m
            axis[tip] = axis[tip] + out / np.linalg.norm(out) * off_m
        diameter_m = 2 * body.radius_m * np.exp(rng.normal(0, _GIRTH_SD))
        fruit_list.append(_measured_fruit(picture, label, mask, axis, diameter_m, body))
    return fruit_list


@dataclass(frozen=True, eq=False)
class _Body:
    """A fruit's true axis from blossom to stem end, its radius and lengths, metres."""

    axis_m: Array
    radius_m: float
    lengths_m: tuple[float, float, float]
    stem_known: bool


def _drawn_body(label: Label) -> _Body | None:
    extras = label.extras
    if "axis_m" not in extras:
        return None
    lengths = extras["centreline_m"], extras["thread_m"], extras["chord_m"]
    return _Body(np.array(extras["axis_m"]), float(max(extras["radius_m"])), lengths, True)


def _pasted_body(label: Label, camera: Intrinsics) -> _Body | None:
    outline = label.amodal
    line = None if outline is None or label.cut_off else axis_line(outline)
    if outline is None or line is None:
        return None
    x, y = camera.rays(line[:, 0], line[:, 1])
    axis = _PASTED_AT_M * np.stack([x, y, np.ones(len(x))], axis=1)
    radius_m = float(distances_inside(outline).max()) * _PASTED_AT_M / camera.fx_px
    length_m = float(arc_positions(axis)[-1])
    if length_m < _LEAST_ASPECT * radius_m:
        return None
    return _Body(axis, radius_m, (length_m, length_m, length_m), False)


def camera_of(picture: LabelledPicture) -> Intrinsics:
    """Return a picture's camera; of a photo, one whose focal length is its longer side."""
    if picture.camera is not None:
        return picture.camera
    width, height = picture.width, picture.height
    focal = float(max(width, height))
    return Intrinsics(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)


def measure_drawn(
    picture: LabelledPicture, data: DataSet, *, given: bool = True
) -> list[MeasuredFruit]:
    """Measure the fruit of a drawn picture on the networks' masks and on the labels'.

    Parameters
    ----------
    picture : LabelledPicture
        With depth, camera, and the fruit's true axes.
    data : DataSet
        Its set.
    given : bool
        Whether to measure on the labels' masks too.
    """
    capture = capture_of(picture, data, read_color(data.path(picture)))
    labels = [x for x in picture.labels if "axis_m" in x.extras and x.mask_code is not None]
    if capture is None or not labels:
        return []
    measured = _matched(_measurer().measure(capture).fruit, labels)
    records = [_record(fruit, label, picture, given=False) for fruit, label in measured]
    for label in labels if given else ():
        mask = label.mask
        if not label.ignore and mask is not None and np.count_nonzero(mask) >= _LEAST_SEEN:
            instance = Instance(label.box, mask=mask, mask_source=MaskSource.DATASET)
            fruit = measure_fruit(capture, instance, (MethodName.M6,))
            records.append(_record(fruit, label, picture, given=True))
    return [record for record in records if record is not None]


@lru_cache(maxsize=1)
def _measurer() -> Measurer:
    return Measurer(MeasureOptions(instances="models", methods=(MethodName.M6,)))


def _matched(fruits: tuple[Fruit, ...], labels: list[Label]) -> Iterator[tuple[Fruit, Label]]:
    ious = box_ious(
        np.array([fruit.instance.box for fruit in fruits]).reshape(-1, 4),
        np.array([label.box for label in labels]),
    )
    for k, fruit in enumerate(fruits):
        best = int(ious[k].argmax())
        if ious[k, best] > _FOUND_IOU and k == int(ious[:, best].argmax()):
            yield fruit, labels[best]


def _record(
    fruit: Fruit, label: Label, picture: LabelledPicture, *, given: bool
) -> MeasuredFruit | None:
    m6, body = fruit.measurements.get(MethodName.M6), _drawn_body(label)
    if m6 is None or m6.fit is None or m6.tube is None or fruit.mask is None or body is None:
        return None
    features = {
        **tube_features(m6),
        **mask_features(fruit.mask_source, fruit.flags, fruit.instance.confidence),
    }
    traits, tube = m6.fit.traits, m6.tube
    return _measured_fruit(
        picture,
        label,
        fruit.mask,
        traits.axis_m,
        traits.diameter_max_m,
        body,
        given=given,
        lengths_m=(tube.centreline_m, tube.thread_m, tube.chord_m),
        features={name: round(value, 5) for name, value in features.items()},
    )


def _measured_fruit(
    picture: LabelledPicture,
    label: Label,
    mask: Mask,
    axis_m: Array,
    diameter_m: float,
    body: _Body,
    **measured: Any,
) -> MeasuredFruit:
    even = points_along(axis_m, np.linspace(0, 1, AXIS_POINTS)).round(5)
    missing_m, stem_first = end_truths(axis_m, body.axis_m)
    fields: dict[str, Any] = {
        "mask": Rle.of(mask),
        "axis_m": tuple(tuple(point) for point in even.tolist()),
        "diameter_m": float(diameter_m),
        "lengths_m": (float(arc_positions(axis_m)[-1]),) * 3,
        "true_m": body.lengths_m,
        "missing_m": missing_m,
        "stem_first": stem_first if body.stem_known else None,
        "hidden_share": float(label.hidden_share or 0.0),
        "cut": label.cut_off,
        "held_out": is_held_out(picture, HELD_OUT),
    }
    return MeasuredFruit(picture=picture.file, **fields | measured)


def measured_fruit(
    data: DataSet, keep: Path, progress: Progress | None = None
) -> list[MeasuredFruit]:
    """Measure every picture of a drawn set, or read from a file what was measured before.

    Those of held-out scenes come first, on the networks' masks alone; after every fourth of them
    one to train on, on the labels' masks too.

    Parameters
    ----------
    data : DataSet
        A set by `cucumbervision synth` with depth.
    keep : Path
        The file: one line of JSON a picture.
    progress : callable, optional
        Called with the number of pictures finished since the last call.

    Raises
    ------
    DataSetError
        If the file is damaged.
    """
    held = [is_held_out(picture, HELD_OUT) for picture in data.pictures]
    turn = [
        sum(h == is_held for h in held[:k]) * (1 if is_held else 4)
        for k, is_held in enumerate(held)
    ]
    order = np.argsort(turn, kind="stable").tolist()
    jobs = {data.pictures[k].file: (data.pictures[k], not held[k]) for k in order}
    rows = kept_rows(keep, jobs, partial(_measured_rows, data), progress=progress)
    return TypeAdapter(list[MeasuredFruit]).validate_python(rows)


def _measured_rows(data: DataSet, job: tuple[LabelledPicture, bool]) -> list[dict[str, Any]]:
    picture, given = job
    return [asdict(fruit) for fruit in measure_drawn(picture, data, given=given)]


MISSING = 0.05
"""Share of a fruit's length from which an end counts as covered, or as running on."""

_TRUE_END = 0.03  # of the length: an end that lies no farther off is covered from there
_END_OFF = 0.2  # radii by which a covered end errs (standard deviation)
_LEAST_RADIUS_PX, _AROUND_RADII = 4.0, 7.0  # of fruit whose ends are covered; the part around them
_MOVED_SD = 0.7  # radii that a further copy of each end of training is moved along the axis

END_CROP = np.dtype(
    [
        ("planes", np.uint8, (END_PX, END_PX, PLANES)),
        ("shapes", np.float32, (2,)),
        ("missing", np.float32),
        ("stem", np.float32),
        ("fruit", np.int64),
        ("moved", np.bool_),
        ("held_out", np.bool_),
    ],
    align=True,  # as torch wants arrays
)
"""Crops around the ends of measured fruit.

`planes` and `shapes` as `EndCrop`; `missing`, the share of the true length that is missing there,
negative where too much was measured; `stem`, whether it is the stem end, NaN where that is not
known; `fruit`, the number among those that were given; `moved`, whether it is a copy that was moved
along the axis; `held_out`, whether its scene is not trained on.
"""


def states_of(crops: Crops) -> NDArray[np.int64]:
    """Return the index into `STATES` of each end."""
    return np.where(crops.missing > MISSING, 1, np.where(crops.missing < -MISSING, 2, 0))


def joined_ends(parts: Sequence[Crops]) -> Crops:
    """Return the crops of several sets as one; fruit are numbered on."""
    crops, first = np.concatenate(parts).view(np.recarray), 0
    for end, part in zip(np.cumsum([len(part) for part in parts]), parts, strict=True):
        crops.fruit[end - len(part) : end] += first
        first += int(part.fruit.max(initial=-1)) + 1
    return crops


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


def _with_captures(
    numbered: Iterable[tuple[int, MeasuredFruit]], data: DataSet
) -> Iterator[tuple[Capture, int, MeasuredFruit]]:
    """Yield fruit with their captures; each picture is read once for those that follow."""
    pictures = {picture.file: picture for picture in data.pictures}
    for file, group in groupby(numbered, lambda entry: entry[1].picture):
        picture, color = pictures[file], read_color(data.path(pictures[file]))
        no_depth = np.zeros(color.shape[:2], np.float32)
        capture = capture_of(picture, data, color)
        capture = capture or Capture(color, no_depth, camera_of(picture), picture.file)
        yield from ((capture, number, measured) for number, measured in group)


def collect_end_crops(fruit: Sequence[MeasuredFruit], data: DataSet, seed: int = 0) -> Crops:
    """Cut out both ends of fruit, and of those of training each once more, moved along the axis.

    Parameters
    ----------
    fruit : sequence of MeasuredFruit
        Of `measured_fruit`, those of a picture one after the other.
    data : DataSet
        Their set.
    seed : int
        Random seed of the moves.

    Returns
    -------
    recarray of END_CROP

    Raises
    ------
    TrainingError
        If there are no fruit.
    CaptureError
        If a picture cannot be read.
    """
    rng, rows = np.random.default_rng(seed), []
    for capture, number, measured in _with_captures(enumerate(fruit), data):
        mask, diameter_m = measured.mask.decode(), measured.diameter_m
        image = capture.color, capture.depth_m, mask, capture.intrinsics
        for line, missing_m, stem in measured.ends():
            moves = [0.0]
            if not measured.held_out:
                moves.append(float(rng.normal(0, _MOVED_SD)) * diameter_m / 2)
            for by_m in moves:
                crop = end_crop(*image, moved_axis(line, by_m) if by_m else line, diameter_m)
                missing = (missing_m - by_m) / measured.true_m[0]
                numbers = number, by_m != 0, measured.held_out
                rows.append((crop.planes, crop.shape, missing, stem, *numbers))
    if not rows:
        raise TrainingError(
            "no measured fruit", source=data.folder, remedy="give a drawn set with depth"
        )
    return crops_of(rows, END_CROP)


def collect_covered_ends(
    fruit: Sequence[MeasuredFruit], data: DataSet, pieces: Sequence[Cutout], seed: int = 0
) -> Crops:
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
    recarray of END_CROP
        Empty without an end to lay anything over.

    Raises
    ------
    CaptureError
        If a picture cannot be read.
    """
    rng, rows = np.random.default_rng(seed), []
    learnt = [(k, body) for k, body in enumerate(fruit) if not (body.cut or body.held_out)]
    for capture, number, measured in _with_captures(learnt, data):
        for line, missing_m, stem in measured.ends():
            if abs(missing_m) <= _TRUE_END * measured.true_m[0]:
                covered = _covered_end(measured, line, missing_m, capture, pieces, rng)
                rows += [] if covered is None else [(*covered, stem, number, False, False)]
    return crops_of(rows, END_CROP)


def _covered_end(
    fruit: MeasuredFruit,
    line_m: Array,
    missing_m: float,
    capture: Capture,
    pieces: Sequence[Cutout],
    rng: Generator,
) -> tuple[Any, Any, float] | None:
    """Return the planes and the shape of a covered end, and the share that is missing there."""
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
    return crop.planes, crop.shape, (missing_m + lost_m - by_m) / fruit.true_m[0]


def collect_set(
    data: DataSet,
    keep: Path,
    seed: int = 0,
    progress: Progress | None = None,
    pieces: Sequence[Cutout] = (),
) -> tuple[list[MeasuredFruit], Crops]:
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
    crops : recarray of END_CROP
        Their ends.

    Raises
    ------
    TrainingError, CaptureError
        As `collect_end_crops`.
    """
    measured = measured_fruit(data, keep, progress)
    rng = np.random.default_rng(seed)
    fruit = [
        labelled
        for picture in data.pictures
        if picture.depth_file is None or not is_held_out(picture, HELD_OUT)
        for labelled in labelled_fruit(picture, rng)
    ]
    covered = collect_covered_ends(fruit, data, pieces, seed) if pieces else crops_of([], END_CROP)
    fruit += measured
    crops = collect_end_crops(fruit, data, seed)
    return fruit, np.append(crops, covered).view(np.recarray)
