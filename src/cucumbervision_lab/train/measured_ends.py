"""Fruit of drawn scenes as M6 measures them, with where their true ends are."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter
from scipy.spatial import cKDTree

from cucumbervision.capture.frames import Capture
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.capture.pictures import read_color
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


@dataclass(frozen=True)
class EndTruth:
    """What is true of one end of a measured axis.

    Parameters
    ----------
    missing_m : float
        How far the true end lies beyond the measured one along the true axis, metres; negative
        where the measured one lies beyond the fruit.
    is_stem : bool, optional
        Whether it is the stem end; None where that is not known.
    """

    missing_m: float
    is_stem: bool | None


@dataclass(frozen=True)
class MeasuredFruit:
    """One fruit of a drawn picture, measured by M6.

    Parameters
    ----------
    picture, scene : str
        The picture's file, and its scene.
    held_out : bool
        Whether it is not trained on.
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
    ends : tuple of EndTruth
        Of the first and the last point of the axis.
    hidden_share : float
        Occluded share of the fruit, 0 to 1.
    cut : bool
        Whether the fruit goes on beyond the picture.
    features : dict of str to float
        Of the interval model.
    """

    picture: str
    scene: str
    given: bool
    mask: Rle
    axis_m: tuple[tuple[float, ...], ...]
    diameter_m: float
    lengths_m: tuple[float, float, float]
    true_m: tuple[float, float, float]
    ends: tuple[EndTruth, EndTruth]
    hidden_share: float
    cut: bool
    held_out: bool = False
    features: Mapping[str, float] = field(default_factory=dict)

    @property
    def relative_missing(self) -> tuple[float, float]:
        """How much of the true length is missing at either end; negative for too much."""
        first, last = (end.missing_m / self.true_m[0] for end in self.ends)
        return first, last


def end_truths(axis_m: Array, true_m: Array) -> tuple[EndTruth, EndTruth]:
    """Return what is true of both ends of a measured axis.

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
    >>> [(round(end.missing_m, 3), end.is_stem) for end in end_truths(axis, true)]
    [(-0.01, True), (0.03, False)]
    """
    run = arc_positions(true_m)
    places = [_place_along(true_m, run, tip) for tip in (axis_m[0], axis_m[-1])]
    stem_first = places[0] > places[1]
    length = float(run[-1])
    truths = []
    for place, is_stem in zip(places, (stem_first, not stem_first), strict=True):
        missing = length - place if is_stem else place
        truths.append(EndTruth(round(missing, 5), is_stem))
    return truths[0], truths[1]


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
    fruits = _measurer().measure(capture).fruit
    records = [
        record
        for fruit, label in _matched(fruits, labels)
        if (record := _record(fruit, label, picture, given=False)) is not None
    ]
    for label in labels if given else ():
        if not label.ignore and (fruit := _measured_given(capture, label)) is not None:
            record = _record(fruit, label, picture, given=True)
            records += [] if record is None else [record]
    return records


@lru_cache(maxsize=1)
def _measurer() -> Measurer:
    return Measurer(MeasureOptions(instances="models", methods=(MethodName.M6,)))


def _measured_given(capture: Capture, label: Label) -> Fruit | None:
    mask = label.mask
    if mask is None or np.count_nonzero(mask) < _LEAST_SEEN:
        return None
    instance = Instance(label.box, mask=mask, mask_source=MaskSource.DATASET)
    return measure_fruit(capture, instance, (MethodName.M6,))


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
    m6 = fruit.measurements.get(MethodName.M6)
    if m6 is None or m6.fit is None or m6.tube is None or fruit.mask is None:
        return None
    features = {
        **tube_features(m6),
        **mask_features(fruit.mask_source, fruit.flags, fruit.instance.confidence),
    }
    traits, tube = m6.fit.traits, m6.tube
    body = _drawn_body(label)
    if body is None:
        return None
    axis, diameter = traits.axis_m, traits.diameter_max_m
    measured = _measured_fruit(picture, label, fruit.mask, axis, diameter, body)
    return replace(
        measured,
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
) -> MeasuredFruit:
    even = points_along(axis_m, np.linspace(0, 1, AXIS_POINTS)).round(5)
    length_m = float(arc_positions(axis_m)[-1])
    ends = end_truths(axis_m, body.axis_m)
    if not body.stem_known:
        ends = replace(ends[0], is_stem=None), replace(ends[1], is_stem=None)
    return MeasuredFruit(
        picture.file,
        picture.scene or picture.file,
        given=True,
        mask=Rle.of(mask),
        axis_m=tuple(tuple(point) for point in even.tolist()),
        diameter_m=float(diameter_m),
        lengths_m=(length_m, length_m, length_m),
        true_m=body.lengths_m,
        ends=ends,
        hidden_share=float(label.hidden_share or 0.0),
        cut=label.cut_off,
        held_out=is_held_out(picture, HELD_OUT),
    )


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
