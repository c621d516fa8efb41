from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from cucumbervision.arrays import Array
from cucumbervision.fruit.instance import (
    Instance,
    merge_instances,
    with_disjoint_masks,
    with_keypoints,
)
from cucumbervision.fruit.masks import box_of_mask

HEIGHT, WIDTH = 160, 240
Mask = NDArray[np.bool_]


def bar(u: float, v: float, length_px: float, width_px: float, turn_deg: float = 0.0) -> Mask:
    """A bar's pixels: its middle, length, width and turn."""
    y, x = np.indices((HEIGHT, WIDTH))
    turn = np.deg2rad(turn_deg)
    along = (x - u) * np.cos(turn) + (y - v) * np.sin(turn)
    across = (y - v) * np.cos(turn) - (x - u) * np.sin(turn)
    return np.asarray((np.abs(along) <= length_px / 2) & (np.abs(across) <= width_px / 2))


def found(mask: Mask, score: float, keypoints: Array | None = None) -> Instance:
    return Instance(box_of_mask(mask), score, detector_mask=mask, keypoints=keypoints)


def masks_of(instances: Sequence[Instance]) -> set[bytes]:
    return {i.detector_mask.tobytes() for i in instances if i.detector_mask is not None}


def test_a_box_in_a_box_leaves_the_whole_with_the_better_score() -> None:
    whole, part = bar(100, 80, 120, 20), bar(80, 80, 50, 20)
    (instance,) = merge_instances([found(part, 0.9), found(whole, 0.5)])
    assert instance.box.tolist() == box_of_mask(whole).tolist()
    assert instance.confidence == 0.9


def test_a_whole_that_is_hardly_believed_does_not_replace_a_part() -> None:
    whole, part = bar(100, 80, 120, 20), bar(80, 80, 70, 20)
    (instance,) = merge_instances([found(part, 0.9), found(whole, 0.4)])
    assert instance.box.tolist() == box_of_mask(part).tolist()


def test_pieces_beside_the_whole_are_the_whole() -> None:
    whole = bar(120, 80, 160, 20) & ~bar(120, 80, 30, 40)
    pieces = [found(bar(72, 80, 60, 20), 0.7), found(bar(168, 80, 60, 20), 0.6)]
    (instance,) = merge_instances([*pieces, found(whole, 0.8)])
    assert instance.box.tolist() == box_of_mask(whole).tolist()


def test_a_box_around_two_fruit_goes() -> None:
    # Touching side by side; each by itself is believed more than both as one.
    upper, lower = bar(120, 70, 140, 20), bar(120, 90, 140, 20)
    merged = merge_instances([found(upper, 0.9), found(upper | lower, 0.6), found(lower, 0.8)])
    assert masks_of(merged) == {upper.tobytes(), lower.tobytes()}
    assert [instance.confidence for instance in merged] == [0.9, 0.8]


def test_a_speck_in_two_fruit_makes_them_no_single_one() -> None:
    lying, standing = bar(120, 80, 150, 24), bar(120, 80, 24, 120)
    speck = lying & standing
    merged = merge_instances([found(lying, 0.9), found(standing, 0.8), found(speck, 0.5)])
    assert masks_of(merged) == {lying.tobytes(), standing.tobytes()}


@settings(max_examples=80, deadline=None)
@given(
    first=st.floats(0, 180),
    turn=st.floats(35, 145),
    length_px=st.floats(70, 140),
    aspect=st.floats(3, 8),
    off=st.tuples(st.floats(-30, 30), st.floats(-30, 30)),
)
def test_fruit_that_cross_stay_two(
    first: float, turn: float, length_px: float, aspect: float, off: tuple[float, float]
) -> None:
    # Whole masks of both, the crossing in each: the worst that a detector can draw. Bars of width
    # w that cross at an angle share w^2 / sin(angle): here at most 1 / (3 sin 35) = 0.58 of each.
    width_px = length_px / aspect
    a = bar(120, 80, length_px, width_px, first)
    b = bar(120 + off[0], 80 + off[1], length_px, width_px, first + turn)
    assert len(merge_instances([found(a, 0.9), found(b, 0.8)])) == 2


@settings(max_examples=40, deadline=None)
@given(gap=st.integers(0, 30), long=st.integers(40, 100), wide=st.integers(10, 30))
def test_fruit_that_touch_stay_two(gap: int, long: int, wide: int) -> None:
    a = np.zeros((HEIGHT, WIDTH), bool)
    b = a.copy()
    a[20 : 20 + wide, 10 : 10 + long] = True
    b[20 + wide + gap : 20 + 2 * wide + gap, 10 : 10 + long] = True
    assert len(merge_instances([found(a, 0.9), found(b, 0.9)])) == 2


@settings(max_examples=50, deadline=None)
@given(data=st.data())
def test_shifted_repeats_change_no_count_and_order_no_result(data: st.DataObject) -> None:
    # Three fruit side by side, each found up to three times, a few pixels off.
    fruit: list[Instance] = []
    for k in range(3):
        for _ in range(data.draw(st.integers(1, 3))):
            shift = data.draw(st.integers(-8, 8))
            score = 0.4 + 0.01 * len(fruit)
            fruit.append(found(bar(120 + shift, 30 + 50 * k, 120, 24), score))
    merged = merge_instances(fruit)
    assert len(merged) == 3
    assert masks_of(merged) <= masks_of(fruit)
    assert max(instance.confidence for instance in merged) == max(
        instance.confidence for instance in fruit
    )
    reordered = merge_instances(data.draw(st.permutations(fruit)))
    assert [instance.box.tolist() for instance in reordered] == [
        instance.box.tolist() for instance in merged
    ]
    assert masks_of(merge_instances(merged)) == masks_of(merged)


def test_keypoints_are_the_keepers_own_or_else_the_bests() -> None:
    whole, part = bar(100, 80, 120, 20), bar(80, 80, 60, 20)
    ones, twos = np.full((5, 3), 1.0), np.full((5, 3), 2.0)
    (instance,) = merge_instances([found(part, 0.9, ones), found(whole, 0.8, twos)])
    assert instance.keypoints is twos
    (given_to,) = merge_instances([found(part, 0.9, ones), found(whole, 0.8)])
    assert given_to.keypoints is ones


def test_boxes_without_masks_are_one_only_where_they_agree() -> None:
    def box(x: float) -> Instance:
        return Instance(np.array([x, 0.0, x + 20, 40.0]))

    # Shifted by 2 of 20: IoU 18/22; by 5: 15/25.
    assert len(merge_instances([box(0), box(2)])) == 1
    assert len(merge_instances([box(0), box(5)])) == 2
    inside = Instance(np.array([2.0, 2, 18, 20]))
    assert len(merge_instances([box(0), inside])) == 2
    assert merge_instances([]) == ()


def fruit_at(x: float, keypoint: float | None = None, width: float = 10) -> Instance:
    points = None if keypoint is None else np.full((5, 3), keypoint)
    return Instance(np.array([x, 0, x + width, 40]), keypoints=points)


def test_keypoints_go_to_the_best_one_to_one() -> None:
    # Pose 7 overlaps both fruits; the sum is largest when each fruit gets its own.
    fruits = [fruit_at(0), fruit_at(2)]
    out = with_keypoints(fruits, [fruit_at(1.5, 7), fruit_at(0.5, 9)])
    assert [o.keypoints[0, 0] for o in out if o.keypoints is not None] == [9, 7]


def test_an_unsure_pose_serves_only_what_no_sure_one_fits() -> None:
    # The unsure poses fit better (IoU 1), but the first fruit has a sure one (9/11).
    unsure = [replace(fruit_at(x, keypoint), confidence=0.1) for x, keypoint in ((0, 3), (30, 4))]
    poses = [replace(fruit_at(1, 7), confidence=0.8), *unsure]
    fruits = [fruit_at(0), fruit_at(30), fruit_at(60, 5)]
    out = with_keypoints(fruits, poses, sure=0.3)
    assert [o.keypoints[0, 0] for o in out if o.keypoints is not None] == [7, 4, 5]


def test_hopeless_pairs_push_no_good_one_aside() -> None:
    # Fruit A overlaps pose 1 by 9.5/10.5 = 0.90 and pose 2 by 4.8/10 = 0.48; fruit B overlaps
    # pose 1 by 0.48. The two 0.48 sum to more than 0.90, but neither may be given.
    fruits = [fruit_at(0), fruit_at(0.5, width=4.8)]
    out = with_keypoints(fruits, [fruit_at(0.5, 1), fruit_at(5.2, 2, width=4.8)])
    assert out[0].keypoints is not None
    assert out[0].keypoints[0, 0] == 1
    assert out[1].keypoints is None


def test_a_mask_that_loses_much_gets_a_new_box() -> None:
    # Two thirds of the wider mask remain below the narrower one, of which more than half is shared.
    upper, both = bar(120, 70, 140, 20), bar(120, 80, 140, 60)
    first, second = with_disjoint_masks([found(upper, 0.9), found(both, 0.6)])
    assert first.detector_mask is not None
    assert second.detector_mask is not None
    assert (first.detector_mask == upper).all()
    assert (second.detector_mask == (both & ~upper)).all()
    assert second.box.tolist() == box_of_mask(both & ~upper).tolist()
