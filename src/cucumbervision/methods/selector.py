"""Measure a fruit by every method, choose a measurement, and add a network's look at its ends."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import TypeAlias

import numpy as np

from cucumbervision.arrays import Array, Mask
from cucumbervision.capture.frames import Capture, valid_depth
from cucumbervision.fruit.crops import EndCrop, EndLook, end_crop
from cucumbervision.fruit.instance import LEAST_END_CONFIDENCE, Instance, MaskSource
from cucumbervision.fruit.masks import mask_pixels, mask_window
from cucumbervision.methods.depth_doubts import depth_doubts
from cucumbervision.methods.flags import Flag
from cucumbervision.methods.intervals import mask_features, with_interval
from cucumbervision.methods.paper_methods import MIN_VISIBILITY, SPLINE_POINTS
from cucumbervision.methods.pose import CUT_BEYOND_M, fruit_pose, stem_first
from cucumbervision.methods.result import (
    Choice,
    Fruit,
    Length,
    LengthDefinition,
    Measurement,
    MethodName,
    Selector,
    calibration_key,
)
from cucumbervision.methods.table import (
    AVAILABLE,
    Method,
    Region,
    TableMethod,
    box_pixels,
    run_methods,
)
from cucumbervision.tube.compiled import OneThread

# Below the 0.50 of M4: the package's pose network gives lower visibility even to visible ends.
_IN_SIGHT = 0.40

_BEYOND = 0.10  # of the fruit's length: several times the error of a pose network at an end


def end_doubts(mask: Mask | None, keypoints: Array | None) -> tuple[bool, bool, bool]:
    """Return whether the blossom end and the stem end are hidden, and keypoints and mask disagree.

    An end is hidden if its keypoint has a visibility below 0.40, or lies more than 10 % of the
    fruit's length beyond the mask, because the network expects the fruit to continue behind an
    occluder. If the mask extends beyond a keypoint by as much, one of the two is wrong.

    Parameters
    ----------
    mask : ndarray of bool, shape (H, W), optional
        The fruit's visible pixels.
    keypoints : ndarray of float, shape (5, 3), optional
        u, v in pixels and visibility, KP0 (blossom end) to KP4 (stem end). They are ignored if
        none is visible.

    Examples
    --------
    >>> mask = np.zeros((100, 200), bool)
    >>> mask[45:55, 20:140] = True
    >>> line = np.array([[u, 50.0, 1.0] for u in (20, 55, 90, 125, 160)])
    >>> end_doubts(mask, line), end_doubts(mask, line * [0.85, 1, 1])
    ((False, True, False), (False, False, False))
    """
    if keypoints is None or not (keypoints[:, 2] >= MIN_VISIBILITY).any():
        return False, False, False
    # No reaches for an empty mask or coincident keypoints.
    reaches = _reaches(mask, keypoints[:, :2]) or [0.0, 0.0]
    unseen = keypoints[[0, -1], 2] < _IN_SIGHT
    blossom, stem = (bool(u) or r < -_BEYOND for u, r in zip(unseen, reaches, strict=True))
    return blossom, stem, max(reaches) > _BEYOND


def _reaches(mask: Mask | None, line: Array) -> list[float]:
    """Return how far the mask extends beyond each end's keypoint, relative to the line."""
    steps = np.linalg.norm(np.diff(line, axis=0), axis=1)
    pixels = np.empty((0, 2)) if mask is None else mask_pixels(mask)
    if not len(pixels) or not steps.all():
        return []
    # Each pixel belongs to its nearest part of the line, so that the other end of a bent fruit is
    # ignored.
    middles = (line[:-1] + line[1:]) / 2
    away = (middles**2).sum(axis=1)[:, None] - 2 * middles @ pixels.T
    nearest = away[0] <= away[1:].min(axis=0), away[-1] < away[:-1].min(axis=0)
    reaches = []
    for tip, inner, part in ((0, 1, 0), (-1, -2, -1)):
        ahead = (line[tip] - line[inner]) / np.linalg.norm(line[tip] - line[inner])
        part_pixels = pixels[nearest[part]]
        # Without a pixel near this part, the mask ends before it.
        reach = (
            float(((part_pixels - line[tip]) @ ahead).max())
            if len(part_pixels)
            else -float(steps[part])
        )
        reaches.append(reach / float(steps.sum()))
    return reaches


_ELONGATED = 1.8

_EDGE_PX = 1.0

_LEAST_FILL = 0.1  # share of a fruit's pixels with a reading: with fewer, lengths are guesses


def choose(
    measurements: Mapping[str, Measurement],
    mask_points: int | None,
    box: Array,
    selector: Selector = Selector.BEST,
    methods: Iterable[Method] = (),
) -> tuple[Measurement | None, Choice, tuple[str, ...]]:
    """Choose among measurements by the paper's decision tree.

    The order is that of the ranks in the table of methods. A mask with at least 100 valid points
    (counted before the gate): M5, then M4 if it measured by itself, then M3. A mask with fewer: M3.
    No mask, or all of these failed: M1 then M2 for a box at least 1.8 times as long as wide (lying
    or hanging), M2 then M1 otherwise. `BEST` puts M6 first if it was run and succeeded; `PAPER`
    never takes it.

    Parameters
    ----------
    measurements : mapping of str to Measurement
        The measurements; methods that were not run are skipped.
    mask_points : int, optional
        Valid depth readings in the mask; None without a mask.
    box : ndarray of float, shape (4,)
        Edges x1, y1, x2, y2 in pixels.
    selector : Selector
        Rule of the choice.
    methods : iterable of Method
        Methods among them that are not in the table.

    Returns
    -------
    measurement : Measurement or None
        The chosen measurement; None if no method succeeded.
    choice : Choice
        The decision that determined the order.
    fallback : tuple of str
        Each method that failed before, with its reason, in order.

    Examples
    --------
    >>> import numpy as np
    >>> from cucumbervision.methods.result import MethodName, Reason
    >>> m5 = Measurement(MethodName.M5, reason=Reason.TOO_FEW_BINS)
    >>> m3 = Measurement(MethodName.M3, 0.21)
    >>> box = np.array([0, 0, 9, 40.0])
    >>> best, choice, path = choose({m5.method: m5, m3.method: m3}, 400, box)
    >>> str(best.method), str(choice), path
    ('M3', 'mask-points-ge-100', ('M5:too-few-bins',))
    """
    width, height = float(box[2] - box[0]), float(box[3] - box[1])
    elongated = max(width, height) >= _ELONGATED * min(width, height)
    choice = Choice.ELONGATED_BOX if elongated else Choice.COMPACT_BOX
    if mask_points is not None:
        choice = Choice.DENSE_MASK if mask_points >= SPLINE_POINTS else Choice.SPARSE_MASK
    method_of, ranked, tried = {str(m.name): m for m in methods}, [], list[str]()
    for name, measurement in measurements.items():
        if measurement.error is None:
            method = TableMethod.of(method_of.get(name, name))
            rank = method.rank_for(mask_points, is_elongated=elongated)
            if rank is not None and (method.is_paper or selector is not Selector.PAPER):
                ranked.append((rank, name, method))
    for _, name, method in sorted(ranked, key=lambda line: line[:2]):
        result = measurements[name]
        if result.measured_by is not None and not method.stands_in:
            continue
        if result.length_m is not None:
            return result, choice, (*tried, *result.fallback)
        tried.extend(result.fallback or [f"{name}:{result.reason}"])
    return None, choice, tuple(tried)


@OneThread()
def measure_fruit(
    capture: Capture,
    instance: Instance,
    methods: Iterable[str | Method] = AVAILABLE,
    selector: Selector = Selector.BEST,
    definition: LengthDefinition = LengthDefinition.CENTRELINE,
    *,
    scale_known: bool = False,
    cut_beyond_m: float = CUT_BEYOND_M,
    tube: Measurement | None = None,
) -> Fruit:
    """Measure one detected fruit, choose among the methods, and compute the length's interval.

    Parameters
    ----------
    capture : Capture
        The frame.
    instance : Instance
        The detection of the fruit.
    methods : iterable of str or Method
        Methods to run; the selector chooses among these.
    selector : Selector
        How to choose.
    definition : LengthDefinition
        Definition of length for a fitted tube; other methods give their raw length.
    scale_known : bool
        Whether the camera's depth scale was measured with a bar of known length; if not, the
        interval holds the scale's own uncertainty.
    cut_beyond_m : float
        Distance of the cut beyond the stem end, metres.
    tube : Measurement, optional
        M6 of the instance's mask in this capture, if it was already measured.

    Returns
    -------
    Fruit
        Always: a fruit that no method measured says why in `reason` and `fallback`.

    Examples
    --------
    >>> import numpy as np
    >>> from cucumbervision.capture.frames import Capture
    >>> from cucumbervision.capture.intrinsics import Intrinsics
    >>> from cucumbervision.fruit.instance import Instance
    >>> capture = Capture(
    ...     np.zeros((480, 640, 3), np.uint8),
    ...     np.full((480, 640), 0.6, np.float32),
    ...     Intrinsics(640, 480, 600.0, 600.0, 320.0, 240.0),
    ...     name="a",
    ... )
    >>> fruit = measure_fruit(capture, Instance(np.array([219.5, 229.5, 419.5, 249.5])))
    >>> str(fruit.method), str(fruit.reason), str(fruit.length.kind)
    ('M1', 'no-mask-box-elongated', 'box-chord')
    >>> round(fruit.length.value_m, 3), round(fruit.length.low_m, 2) == 0.2
    (0.2, True)
    """
    mask, source, flags = _mask_to_measure(instance, selector)
    region = Region(capture.depth_m, capture.intrinsics, instance.box, mask, instance.keypoints)
    method_of = {method if isinstance(method, str) else method.name: method for method in methods}
    to_run = [m for name, m in method_of.items() if tube is None or name != tube.method]
    measured = run_methods(region, to_run)
    if tube is not None and tube.method in method_of:
        measured[tube.method] = tube
    turned = {name: stem_first(reading, instance, capture) for name, reading in measured.items()}
    measurements = {name: measurement for name, (measurement, _) in turned.items()}
    points = None if region.mask_points_m is None else len(region.mask_points_m)
    handed = [method for method in method_of.values() if not isinstance(method, str)]
    chosen, choice, fallback = choose(measurements, points, instance.box, selector, handed)
    distance_m, fill = _depth_of(capture, instance.box, mask)
    if (fill or 0.0) < _LEAST_FILL:
        chosen, choice = None, Choice.NO_DEPTH
    elif chosen is None:
        choice = Choice.NOTHING
    stem_confidence = 0.5 if chosen is None else turned[chosen.method][1]
    blossom_hidden, stem_hidden, disagree = end_doubts(mask, instance.keypoints)
    hidden = blossom_hidden, stem_hidden
    by_keypoints = {Flag.END_HIDDEN: any(hidden), Flag.ENDS_DISAGREE: disagree}
    flags += _flags(capture, instance, mask, source, chosen, stem_confidence, by_keypoints)
    if any(measurement.error is not None for measurement in measurements.values()):
        flags.append(Flag.PLUGIN_FAILED)
    place_pose = partial(fruit_pose, cut_beyond_m=cut_beyond_m, scale_known=scale_known)
    pose = None if chosen is None else place_pose(chosen, stem_confidence, hidden, capture)
    fruit = Fruit(
        instance=instance,
        measurements=measurements,
        selected=chosen,
        reason=choice,
        fallback=fallback,
        flags=tuple(flags),
        mask=mask,
        mask_source=source,
        distance_m=distance_m,
        fill=fill,
        pose=pose,
    )
    return with_length(fruit, definition, scale_known=scale_known)


def _flags(
    capture: Capture,
    instance: Instance,
    mask: Mask | None,
    source: MaskSource | None,
    chosen: Measurement | None,
    stem_confidence: float,
    by_keypoints: Mapping[Flag, bool],
) -> list[Flag]:
    """Return what is flagged; `stem_confidence` is that of the ends, along the chosen path."""
    flags = []
    if cut_by_frame(instance.box, mask, capture.width, capture.height):
        flags.append(Flag.CUT_BY_FRAME)
    if chosen is not None and chosen.fit is not None:
        flags.extend(chosen.fit.flags)
    flags.extend(flag for flag, holds in by_keypoints.items() if holds and flag not in flags)
    if mask is not None:
        focal_px = capture.intrinsics.fx_px
        by_network = source in _DRAWN
        flags.extend(
            depth_doubts(capture.depth_m, mask, focal_px, capture.color, by_network=by_network)
        )
    by_gravity = capture.gravity is not None and chosen is not None and chosen.path_m is not None
    sure = stem_confidence if by_gravity else instance.end_confidence
    if sure is not None and sure < LEAST_END_CONFIDENCE:
        flags.append(Flag.ENDS_UNSURE)
    flags.extend(Flag(doubt) for doubt in capture.doubts)
    return flags


def with_length(fruit: Fruit, definition: LengthDefinition, *, scale_known: bool = False) -> Fruit:
    """Return a fruit with the length of the measurement that was selected, and its interval.

    Parameters as those of `measure_fruit`.
    """
    chosen = fruit.selected
    length = None if chosen is None else _length(chosen, definition)
    if chosen is None or length is None or fruit.distance_m is None or fruit.fill is None:
        return replace(fruit, length=length)
    measure_interval = partial(
        with_interval,
        distance_m=fruit.distance_m,
        fill=fruit.fill,
        mask=mask_features(fruit.mask_source, fruit.flags, fruit.instance.confidence),
        scale_known=scale_known,
    )
    lengths = {
        calibration_key(measurement.method, kind_length.kind): measure_interval(
            kind_length, measurement
        )[0]
        for measurement in fruit.measurements.values()
        for kind_length in _lengths(measurement)
    }
    length, narrow = measure_interval(length, chosen)
    fruit = replace(fruit, length=length, lengths=lengths)
    return fruit if narrow else fruit.flagged(Flag.INTERVAL_TOO_WIDE)


def _lengths(measurement: Measurement) -> list[Length]:
    if measurement.tube is not None:
        return [
            Length(measurement.tube.of(definition), definition) for definition in LengthDefinition
        ]
    if measurement.length_m is None or measurement.kind is None:
        return []
    return [Length(measurement.length_m, measurement.kind)]


def _length(chosen: Measurement, definition: LengthDefinition) -> Length | None:
    lengths = {length.kind: length for length in _lengths(chosen)}
    return lengths.get(definition, next(iter(lengths.values()), None))


def _mask_to_measure(
    instance: Instance, selector: Selector
) -> tuple[Mask | None, MaskSource | None, list[Flag]]:
    flags = [Flag(f"sam-{instance.mask_failure}")] if instance.mask_failure else []
    if instance.mask is not None:
        return instance.mask, instance.mask_source, flags
    detector_mask = instance.detector_mask
    if selector is Selector.BEST and detector_mask is not None and detector_mask.any():
        return detector_mask, MaskSource.DETECTOR, [*flags, Flag.DETECTOR_MASK]
    return None, None, flags


def cut_by_frame(box: Array, mask: Mask | None, width: int, height: int) -> bool:
    """Return whether a fruit's mask, or its box without one, reaches the picture's edge."""
    if mask is not None:
        edges = (mask[0], mask[-1], mask[:, 0], mask[:, -1])
        return any(bool(edge.any()) for edge in edges)
    # The picture's own edges lie at -0.5 and size - 0.5; a box within a pixel of one is cut.
    return bool(
        min(box[0], box[1]) < _EDGE_PX - 0.5
        or box[2] > width - 0.5 - _EDGE_PX
        or box[3] > height - 0.5 - _EDGE_PX
    )


def _depth_of(capture: Capture, box: Array, mask: Mask | None) -> tuple[float | None, float | None]:
    """Return the median depth of the mask (or box), metres, and the share of valid readings."""
    if mask is None:
        x1, y1, x2, y2 = box_pixels(box, capture.depth_m.shape)
        readings = capture.depth_m[y1:y2, x1:x2]
    else:
        window = mask_window(mask) or ...
        readings = capture.depth_m[window][mask[window]]
    valid = readings[valid_depth(readings)]
    distance_m = float(np.median(valid)) if valid.size else None
    return distance_m, (valid.size / readings.size if readings.size else None)


LookAtEnds: TypeAlias = Callable[[Sequence[EndCrop]], list[EndLook]]
"""Looks at many crops in one batch, as `EndLooker.look`."""

DOUBTFUL = 0.3
"""Probability from which an end that may go on out of sight is named."""

_DRAWN = (MaskSource.DETECTOR, MaskSource.SAM, MaskSource.SEGMENTER)


def with_end_looks(
    capture: Capture,
    fruit: Sequence[Fruit],
    look: LookAtEnds,
    definition: LengthDefinition = LengthDefinition.CENTRELINE,
    *,
    scale_known: bool = False,
) -> list[Fruit]:
    """Return the fruit of a capture with the evaluation of their ends, computed in one batch.

    Intervals are computed again. A fruit whose end may continue out of sight is flagged with the
    position of that end in the picture, unless it has another flag for a lower bound.

    Parameters
    ----------
    capture : Capture
        The frame.
    fruit : sequence of Fruit
        Fruit without M6, or with masks that no network drew, are returned unchanged.
    look : callable
        Evaluates crops of ends.
    definition : LengthDefinition
        Definition of length, as for `measure_fruit`.
    scale_known : bool
        Whether the camera's depth scale is known, as for `measure_fruit`.
    """
    tubes = {
        k: (tube, tube.fit.traits, measured.mask)
        for k, measured in enumerate(fruit)
        if (tube := measured.measurements.get(MethodName.M6)) is not None
        if tube.fit is not None and measured.mask is not None and measured.mask_source in _DRAWN
    }
    if not tubes:
        return list(fruit)
    color, depth_m, intrinsics = capture.color, capture.depth_m, capture.intrinsics
    looks = look(
        [
            end_crop(color, depth_m, mask, intrinsics, line, traits.diameter_max_m)
            for _, traits, mask in tubes.values()
            for line in (traits.axis_m, traits.axis_m[::-1])
        ]
    )
    pairs, measured_again = zip(looks[::2], looks[1::2], strict=True), list(fruit)
    for (k, (tube, traits, _)), pair in zip(tubes.items(), pairs, strict=True):
        ends_px = intrinsics.project(traits.axis_m[[0, -1]])
        looked_at = _looked_at(fruit[k], tube, pair, ends_px)
        measured_again[k] = with_length(looked_at, definition, scale_known=scale_known)
    return measured_again


def _looked_at(
    fruit: Fruit, tube: Measurement, looks: tuple[EndLook, EndLook], ends_px: Array
) -> Fruit:
    looked_at = replace(tube, fit=tube.fit and replace(tube.fit, looks=looks))
    selected = looked_at if fruit.selected is tube else fruit.selected
    measurements = {**fruit.measurements, MethodName.M6: looked_at}
    fruit = replace(fruit, measurements=measurements, selected=selected)
    fruit = fruit.unflagged(Flag.INTERVAL_TOO_WIDE)
    if fruit.at_least or selected is not looked_at:
        return fruit
    doubtful = [
        end_flag(ends_px[k] - ends_px[1 - k])
        for k, look in enumerate(looks)
        if look.covered >= DOUBTFUL
    ]
    return fruit.flagged(*doubtful)


def end_flag(outward_px: Array) -> Flag:
    """Return the flag of a doubtful end by its outward direction in the picture.

    Examples
    --------
    >>> [str(end_flag(np.array(out))) for out in ([5.0, 40.0], [-30.0, 2.0])]
    ['lower-end-doubtful', 'left-end-doubtful']
    """
    across, down = outward_px.tolist()
    if abs(down) >= abs(across):
        return Flag.LOWER_END if down > 0 else Flag.UPPER_END
    return Flag.RIGHT_END if across > 0 else Flag.LEFT_END
