from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from cucumbervision.arrays import Mask, Numbers
from cucumbervision.errors import InstancesError
from cucumbervision.fruit.instance import Instance
from cucumbervision.fruit.mask_codes import Rle, decode_rle, encode_rle
from cucumbervision.fruit.masks import (
    as_mask,
    box_of_mask,
    disjoint_masks,
    distances_inside,
    is_box_mask,
    mask_iou,
    mask_window,
    share_inside,
    suppress,
    without_flower,
    without_spurs,
)

MASKS = arrays(bool, array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=40))


@settings(deadline=None, max_examples=80)
@given(MASKS)
def test_what_is_written_reads_back(mask: Mask) -> None:
    code = Rle.of(mask)
    assert np.array_equal(code.decode(), mask)
    assert code.area_px == mask.sum()


def test_the_characters_are_pycocotools_own() -> None:
    coder = pytest.importorskip("pycocotools.mask")
    rng = np.random.default_rng(7)
    masks = [rng.random((40, 70)) < share for share in (0.0, 0.02, 0.5, 0.98, 1.0)]
    # Runs of thousands of pixels, and ones much shorter than the last but one.
    masks.append(np.zeros((300, 400), bool))
    masks[-1][20:220, 100:102] = masks[-1][250:252, 300] = True
    for mask in masks:
        theirs = coder.encode(np.asfortranarray(mask.astype(np.uint8)))
        assert encode_rle(mask) == theirs["counts"].decode("ascii")


def packed(*runs: int) -> str:
    """COCO's characters for numbers of any size, without differences (two runs at most)."""
    text = ""
    for run in runs:
        while True:
            low, run = run & 0x1F, run >> 5
            more = run != (-1 if low & 0x10 else 0)
            text += chr((low | (0x20 if more else 0)) + 48)
            if not more:
                break
    return text


@pytest.mark.parametrize(
    "counts",
    [
        # The sum in 64 bits is right: 4 * 2**62 wraps around to nothing.
        [2**62] * 4 + [4 * 6],
        [2**63, 2**63, 24],
        [2**64 + 24],
        [10**400],
        [30, -6],
        [23],
        [25],
        [],
        [float("nan")],
        [11.5, 12.5],
        packed(2**62, 2**62) + packed(0, 0) + packed(24 - 2**62),
        packed(2**64 + 24),
        packed(30, -6),
        "o" * 1_000_000 + "0",
        "o",
        "é",
        "",
    ],
    ids=lambda counts: repr(counts)[:24],
)
def test_runs_that_do_not_fill_the_picture(counts: str | list[int]) -> None:
    with pytest.raises(ValueError, match="run length"):
        decode_rle(counts, 4, 6)


@settings(deadline=None, max_examples=80)
@given(MASKS, st.integers(0, 3))
def test_a_window_holds_every_pixel_and_no_empty_edge(mask: Mask, margin: int) -> None:
    window = mask_window(mask)
    if window is None:
        assert not mask.any()
        with pytest.raises(ValueError, match="empty"):
            box_of_mask(mask)
        return
    part = mask[window]
    assert part.sum() == mask.sum()
    assert all(edge.any() for edge in (part[0], part[-1], part[:, 0], part[:, -1]))
    left, top, right, bottom = box_of_mask(mask) + 0.5
    assert (top, bottom, left, right) == (*_edges(window[0]), *_edges(window[1]))
    wide = mask_window(mask, margin)
    assert wide is not None
    for side, near, far in zip(mask.shape, window, wide, strict=True):
        assert _edges(far) == (max(near.start - margin, 0), min(near.stop + margin, side))


def _edges(window: slice) -> tuple[int, int]:
    return window.start, window.stop


def strips(*spans: tuple[int, int]) -> list[Mask]:
    """One row's masks from column to column."""
    columns = np.arange(20)[None]
    return [(columns >= start) & (columns < stop) for start, stop in spans]


def widths(masks: Sequence[Mask | None]) -> list[int]:
    return [int(mask.sum()) for mask in masks if mask is not None]


def test_what_is_shared_goes_to_the_surer_and_a_swallowed_one_keeps_all() -> None:
    assert widths(disjoint_masks(strips((0, 10), (8, 18)), [0.4, 0.9])) == [8, 10]
    assert widths(disjoint_masks(strips((0, 10), (8, 18)), [0.9, 0.4])) == [10, 8]
    # 6 of the smaller one's 8 columns lie in the larger.
    assert widths(disjoint_masks(strips((0, 18), (12, 20)), [0.9, 0.4])) == [12, 8]


def test_what_is_shared_goes_to_what_lies_in_front() -> None:
    masks = strips((0, 10), (6, 16))
    depth = np.full((1, 20), 0.60, np.float32)
    depth[:, 10:] = 0.50  # the second's own; both share what is as far as the first
    assert widths(disjoint_masks(masks, [0.4, 0.9], depth)) == [10, 6]
    depth[:, 6:] = 0.50
    assert widths(disjoint_masks(masks, [0.9, 0.4], depth)) == [6, 10]
    assert widths(disjoint_masks(masks, [0.9, 0.4], np.zeros_like(depth))) == [10, 6]


def test_masks_of_one_fruit_and_missing_ones_are_left() -> None:
    a, b = strips((0, 10), (0, 9))
    kept = disjoint_masks([a, None, b], [0.9, 0.5, 0.8])
    assert kept[0] is a
    assert kept[1] is None
    assert kept[2] is b


@settings(max_examples=60, deadline=None)
@given(
    spans=st.lists(st.tuples(st.integers(0, 12), st.integers(1, 8)), min_size=2, max_size=5),
    seed=st.integers(0, 99),
)
@example(spans=[(0, 1), (0, 5), (1, 5), (0, 2)], seed=0)
def test_no_pixel_is_lost_or_won(spans: list[tuple[int, int]], seed: int) -> None:
    masks = strips(*((start, start + wide) for start, wide in spans))
    scores = np.random.default_rng(seed).random(len(masks)).tolist()
    kept = [mask for mask in disjoint_masks(masks, scores) if mask is not None]
    assert all(not (after & ~before).any() for before, after in zip(masks, kept, strict=True))
    assert (np.any(kept, axis=0) == np.any(masks, axis=0)).all()
    # What two masks still share, they share since they are of one fruit.
    for k in range(len(kept)):
        for i in range(k):
            one = mask_iou(masks[i], masks[k]) >= 0.8
            assert one or not (kept[i] & kept[k]).any()


@pytest.mark.parametrize("seed", range(6))
def test_distances_are_the_roots_of_whole_numbers_to_the_last_bit(seed: int) -> None:
    rng = np.random.default_rng(seed)
    mask = np.ones((60 + seed, 90), bool)
    outside = np.column_stack([rng.integers(0, n, 12) for n in mask.shape])
    mask[tuple(outside.T)] = False
    places = np.moveaxis(np.indices(mask.shape), 0, -1)[:, :, None]
    squares = ((places - outside) ** 2).sum(axis=-1).min(axis=-1)
    assert np.array_equal(distances_inside(mask), np.sqrt(squares.astype(np.float32)))


@pytest.mark.parametrize(
    ("dtype", "yes"), [("bool", 1), ("uint8", 255), ("uint8", 1), ("int64", 7), ("float32", 1.0)]
)
def test_any_mask_of_yes_and_no_is_taken(dtype: str, yes: float) -> None:
    expected = np.array([[True, False, True], [False, False, True]])
    given = expected.astype(dtype) * np.array(yes).astype(dtype)
    assert as_mask(given).tolist() == expected.tolist()
    instance = Instance(np.array([0.0, 0, 2, 1]), mask=given, detector_mask=given)
    assert instance.mask is not None
    assert instance.detector_mask is not None
    assert instance.mask.dtype == instance.detector_mask.dtype == np.bool_
    assert not as_mask(np.zeros((2, 2), dtype)).any()


@pytest.mark.parametrize(
    ("mask", "fault"),
    [
        (np.array([[0, 1, 2]]), "values from 1 to 2 beside 0"),
        (np.array([[0.0, 0.4, 0.9]]), "values from 0.4 to 0.9"),
        (np.zeros(3), "1 dimensions"),
        (np.array([["a"]]), "<U1"),
        (np.array([[0.0, np.nan, 1.0]]), "beside 0"),
    ],
)
def test_what_is_no_mask_is_refused(mask: Numbers, fault: str) -> None:
    with pytest.raises(InstancesError, match=fault):
        Instance(np.array([0.0, 0, 2, 1]), mask=mask)


def test_only_a_flower_leaves_the_mask() -> None:
    rows, columns = np.mgrid[:120, :400]
    fruit = ((columns - 180) / 150) ** 2 + ((rows - 60) / 25) ** 2 <= 1
    flower = (abs(columns - 338) < 14) & (abs(rows - 60) < 10)
    color = np.full((120, 400, 3), 90, np.uint8)
    color[fruit] = (70, 110, 50)
    color[fruit & (rows > 70)] = (95, 130, 60)  # a lighter side
    color[flower & ~fruit] = (200, 140, 60)
    cleaned = without_flower(fruit | flower, color)
    assert mask_iou(cleaned, fruit) > 0.98
    # Beside an outline that leaves it out; one that holds it says that it is the fruit's tip.
    assert mask_iou(without_flower(fruit | flower, color, fruit), fruit) > 0.98
    assert np.array_equal(without_flower(fruit | flower, color, fruit | flower), fruit | flower)
    assert np.array_equal(without_flower(fruit, color), fruit)
    # A part as large as a third of the fruit is no flower, and a speck is none.
    color[fruit & (columns > 230)] = (200, 140, 60)
    assert np.array_equal(without_flower(fruit, color), fruit)
    color[fruit] = (70, 110, 50)
    color[58:60, 180:182] = (200, 140, 60)
    assert np.array_equal(without_flower(fruit, color), fruit)


@pytest.mark.parametrize("turn_deg", [0, 17, 45, 90])
def test_a_filled_box_is_told_from_a_fruit(turn_deg: float) -> None:
    sides = ((200.0, 160.0), (150.0, 40.0), turn_deg)
    box = np.zeros((320, 400), np.uint8)
    cv2.fillConvexPoly(box, cv2.boxPoints(sides).round().astype(np.int32), 1)
    assert is_box_mask(box > 0)
    turn = np.deg2rad(turn_deg)
    step = 55 * np.array([np.cos(turn), np.sin(turn)])
    first, second = (
        (np.array([200, 160]) + sign * step).round().astype(int).tolist() for sign in (-1, 1)
    )
    fruit = np.zeros((320, 400), np.uint8)
    cv2.line(fruit, first, second, 1, 40)  # with round ends, 15 times 4 cm
    assert not is_box_mask(fruit > 0)


def test_a_fruit_that_runs_through_the_picture_is_no_box() -> None:
    mask = np.zeros((60, 80), bool)
    mask[20:40] = True
    assert not is_box_mask(mask)


def test_a_stalk_leaves_the_outline_of_a_fruit_and_a_tapering_end_stays() -> None:
    v, u = np.mgrid[:120, :300]
    fruit = ((u - 150) / 100) ** 2 + ((v - 60) / 25) ** 2 <= 1
    stalk = (abs(v - 60) <= 6) & (u > 240) & (u < 290)  # a quarter of the fruit's thickness
    outline = without_spurs(fruit | stalk)
    assert not outline[60, 260:].any()
    # Narrows from 25 px to nothing over 60 px, as the necks of some cultivars do.
    neck = (u > 190) & (u < 250) & (abs(v - 60) < (250 - u) * 25 / 60)
    tapering = ((abs(v - 60) < 25) & (u > 50) & (u <= 190)) | neck
    assert without_spurs(tapering)[60, 190:245].all()


def test_a_stem_beside_a_fruit_leaves_its_outline_and_both_halves_of_a_crossed_one_stay() -> None:
    v, u = np.mgrid[:120, :300]
    fruit = ((u - 150) / 100) ** 2 + ((v - 60) / 25) ** 2 <= 1  # an ellipse with a radius of 25 px
    crossed = fruit & (abs(u - 120) > 6)
    stem = (abs(v - 60) <= 2) & (u > 240)
    knot = (u - 280) ** 2 + (v - 60) ** 2 <= 8**2  # on the stem: thicker than it, no fruit
    outline = without_spurs(crossed | stem | knot)
    assert not outline[60, 260:].any()
    # What an ellipse loses is at most where the stem leaves it and the corners of the cut.
    assert (outline ^ crossed).sum() < 0.02 * crossed.sum()
    assert outline[:, :110].any()
    assert outline[:, 130:].any()
    assert not without_spurs(np.zeros((9, 9), bool)).any()


def test_the_best_region_counts() -> None:
    # A quarter in the first, half in the second: they are not added.
    regions = np.array([[0.0, 0, 1, 1], [2.0, 0, 4, 1]])
    assert share_inside(np.array([[0.0, 0, 4, 1]]), regions).tolist() == [0.5]


def one_class(boxes: list[list[float]], iou: float = 0.7) -> list[int]:
    """The boxes that are left, given best first."""
    scores = np.linspace(0.9, 0.5, len(boxes))
    kept = suppress(np.array(boxes, np.float32), scores, np.zeros(len(boxes), int), iou)
    return [int(k) for k in kept]


def test_suppression_threshold_is_exclusive() -> None:
    # Widths 10 and 7 within each other overlap by exactly 0.7: both stay. 7.5 goes.
    assert one_class([[0, 0, 10, 1], [0, 0, 7, 1]]) == [0, 1]
    assert one_class([[0, 0, 10, 1], [0, 0, 7.5, 1]]) == [0]


def test_a_dropped_box_drops_no_other() -> None:
    # The second goes because of the first; the third overlaps only the second enough.
    assert one_class([[0, 0, 10, 1], [1.5, 0, 11.5, 1], [3, 0, 13, 1]]) == [0, 2]


def test_classes_do_not_suppress_each_other_even_left_of_the_picture() -> None:
    # Shifted by the picture's width, the second would lie on the first.
    boxes = np.array([[90.0, 0, 100, 10], [-11, 0, -1, 10], [90, 0, 100, 10]])
    kept = suppress(boxes, np.array([0.9, 0.8, 0.7]), np.array([0, 1, 1]), 0.5)
    assert kept.tolist() == [0, 1, 2]
