"""Depth that is no depth of the fruit, on capsules of known length and on real captures' masks."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from tests.capsules import CAMERA, Capsule, capsule_capture, lying, with_depth

from cucumbervision.capture.frames import Capture
from cucumbervision.capture.readers import ReadOptions, open_source
from cucumbervision.methods.depth_doubts import depth_doubts, has_coarse_steps
from cucumbervision.methods.flags import NO_DEPTH, Flag, is_lower_bound
from cucumbervision.run.batch import measure
from cucumbervision.run.options import MeasureOptions

Mask = NDArray[np.bool_]


def doubts(capture: Capture, mask: Mask | None = None) -> tuple[Flag, ...]:
    outline = capture.masks[0] if mask is None else mask
    return depth_doubts(capture.depth_m, outline, capture.intrinsics.fx_px, capture.color)


@pytest.mark.parametrize("tilt_deg", [0, 30, 60])
@pytest.mark.parametrize("distance_m", [0.3, 0.5, 0.75])
@pytest.mark.parametrize("noise_m", [0.0, 0.001, 0.003])
def test_true_depth_is_not_doubted(tilt_deg: float, distance_m: float, noise_m: float) -> None:
    fruit = lying(0.16, distance_m=distance_m, tilt_deg=tilt_deg)
    assert doubts(capsule_capture(fruit, wall_m=1.0, noise_m=noise_m)) == ()


@pytest.mark.parametrize("distance_m", [0.3, 0.5])
def test_depth_where_nearer_is_larger_is_hollow(distance_m: float) -> None:
    capture = capsule_capture(lying(0.16, distance_m=distance_m))
    inverse = with_depth(capture, 0.2 / capture.depth_m)
    assert doubts(inverse) == (Flag.DEPTH_HOLLOW,)
    relative = with_depth(capture, 1.1 - capture.depth_m)
    assert doubts(relative) == (Flag.DEPTH_HOLLOW,)


def test_a_unit_that_brings_fruit_too_near_is_doubted_however_near() -> None:
    capture = capsule_capture(lying(0.34, distance_m=0.55), wall_m=1.0)
    for share in (0.2, 0.1):  # 11 cm, and 5.5 cm, which is no reading at all
        (fruit,) = measure(with_depth(capture, capture.depth_m * share), instances="dataset").fruit
        assert Flag.DEPTH_TOO_NEAR in fruit.flags
        assert not fruit.at_least


def with_depth_on(capture: Capture, share: float) -> Capture:
    """Return a capture whose fruit has depth on this share of its pixels, nearest to its outline.

    As before a camera that is too near: it reads a little of the rim, and all of the wall.
    """
    inside = cv2.distanceTransform(capture.masks[0].astype(np.uint8), cv2.DIST_L2, 5)
    limit = np.quantile(inside[capture.masks[0]], share)
    return with_depth(capture, np.where(inside > limit, 0, capture.depth_m))


def test_a_fruit_with_depth_on_less_than_half_of_it_is_flagged_and_has_no_interval() -> None:
    capture = capsule_capture(lying(0.16, distance_m=0.3))
    (fruit,) = measure(with_depth_on(capture, 0.45), instances="dataset").fruit
    assert Flag.DEPTH_SPARSE in fruit.flags
    assert fruit.length is not None
    assert (fruit.length.low_m, fruit.length.high_m) == (None, None)
    assert Flag.INTERVAL_TOO_WIDE not in fruit.flags
    (enough,) = measure(with_depth_on(capture, 0.55), instances="dataset").fruit
    assert Flag.DEPTH_SPARSE not in enough.flags
    assert enough.length is not None
    assert enough.length.low_m is not None


@pytest.mark.parametrize("share", [0.0, 0.001, 0.2])
def test_a_hidden_end_of_a_fruit_with_hardly_any_depth_gives_no_lower_bound(share: float) -> None:
    flags = doubts(with_depth_on(capsule_capture(lying(0.16, distance_m=0.3)), share))
    assert Flag.DEPTH_SPARSE in flags
    assert not is_lower_bound([Flag.END_HIDDEN, *flags])


@pytest.mark.parametrize("gap_m", [0.03, 0.06])
def test_two_fruit_in_one_outline_are_no_fruit_with_a_hidden_part(gap_m: float) -> None:
    across_m = 0.06 + gap_m / 2
    capture = capsule_capture(lying(0.12, across_m=-across_m), lying(0.12, across_m=across_m))
    both = capture.masks[0] | capture.masks[1]
    assert doubts(capture, both) == (Flag.DEPTH_GAP,)
    assert doubts(capture, capture.masks[0]) == ()
    # The same pieces of one fruit behind something nearer, such as a string or a leaf.
    one = capsule_capture(lying(0.24 + gap_m))
    middle = np.zeros_like(both)
    middle[:, 320 - 12 : 320 + 12] = True
    covered = with_depth(one, np.where(middle, 0.42, one.depth_m))
    assert doubts(covered, one.masks[0] & ~middle) == ()


def turned(across_m: float, down_m: float, turn_deg: float, distance_m: float = 0.5) -> Capsule:
    """Return a capsule of 12 cm across the view, turned in the picture."""
    turn = np.deg2rad(turn_deg)
    along = 0.04 * np.array([np.cos(turn), np.sin(turn), 0.0])
    middle = np.array([across_m, down_m, distance_m])
    return Capsule(tuple(middle - along), tuple(middle + along))


@pytest.mark.parametrize(
    ("pair", "flags"),
    [
        ((turned(-0.06, 0, 0), turned(0.06, 0, 0)), {Flag.DEPTH_GAP}),
        ((turned(-0.04, -0.02, 0), turned(0.04, 0.02, 0)), {Flag.DEPTH_GAP, Flag.POOR_FIT}),
        ((turned(-0.04, -0.05, 90), turned(0.02, -0.01, 0)), {Flag.POOR_FIT}),
        ((turned(-0.05, 0, 0), turned(-0.02, -0.045, -45)), {Flag.POOR_FIT}),
        ((turned(0, 0, 0), turned(0, 0.08, 90)), {Flag.DEPTH_GAP, Flag.POOR_FIT}),
        ((turned(0, 0, 60), turned(0, 0, -60, 0.46)), {Flag.POOR_FIT}),
    ],
    ids=["in line", "side by side", "corner", "angle", "T", "X"],
)
def test_two_fruit_that_touch_in_one_outline_are_told(
    pair: tuple[Capsule, Capsule], flags: set[Flag]
) -> None:
    capture = capsule_capture(*pair)
    outline = np.any(capture.masks, axis=0)
    outline = cv2.morphologyEx(outline.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((5, 5))) > 0
    (fruit,) = measure(replace(capture, masks=(outline,)), instances="dataset").fruit
    assert flags <= {*fruit.flags}
    for capsule in pair:
        (alone,) = measure(capsule_capture(capsule), instances="dataset").fruit
        assert not {Flag.DEPTH_GAP, Flag.POOR_FIT} & {*alone.flags}


def test_a_notch_on_one_side_is_no_gap_between_two_fruit() -> None:
    # As where a tendril crosses the outline, and depth there is of the house behind.
    capture = capsule_capture(lying(0.24))
    (mask,) = capture.masks
    rows = np.flatnonzero(mask.any(axis=1))
    thirds = np.linspace(rows[0], rows[-1] + 1, 4).astype(int)
    notch = np.zeros_like(mask)
    notch[thirds[1] : thirds[3], 320 - 6 : 320 + 6] = True
    behind = with_depth(capture, np.where(notch, 2.0, capture.depth_m))
    assert doubts(behind, mask & ~notch) == ()
    notch[thirds[0] : thirds[1], 320 - 6 : 320 + 6] = True  # on both sides: two round ends
    notch[(thirds[0] + thirds[1]) // 2 : (thirds[1] + thirds[2]) // 2] = False
    behind = with_depth(capture, np.where(notch, 2.0, capture.depth_m))
    assert doubts(behind, mask & ~notch) == (Flag.DEPTH_GAP,)


def test_depth_beside_its_outline_and_depth_in_coarse_steps_are_flagged() -> None:
    capture = capsule_capture(lying(0.16))
    beside = with_depth(capture, np.roll(capture.depth_m, 16, axis=0))
    assert doubts(beside) == (Flag.DEPTH_UNALIGNED,)
    coarse = with_depth(capture, np.floor(capture.depth_m / 0.01) * 0.01)
    assert doubts(coarse) == (Flag.DEPTH_COARSE,)


def test_readings_nearer_than_any_that_count_are_too_near_and_raise_nothing() -> None:
    capture = capsule_capture(lying(0.16))
    assert doubts(with_depth(capture, 0 * capture.depth_m + 0.05)) == (Flag.DEPTH_TOO_NEAR,)


def test_an_outline_on_a_bare_wall_is_of_nothing() -> None:
    capture = capsule_capture(lying(0.16))
    wall_m = np.random.default_rng(5).normal(0.8, 0.002, capture.depth_m.shape)
    assert doubts(with_depth(capture, wall_m)) == (Flag.DEPTH_UNALIGNED,)


@pytest.mark.realdata
def test_real_captures_are_not_doubted() -> None:
    data = os.environ.get("CUCUMBERVISION_DATA")
    if data is None:
        pytest.skip("CUCUMBERVISION_DATA names no folder of real captures")
    for name in ("carrot_realsense_1280", "ycb_realsense_640"):
        for ref in open_source(Path(data, "rgbd", name)):
            capture = ref.load()
            for mask in capture.masks:
                assert doubts(capture, mask) == ()


@pytest.mark.realdata
def test_fruit_on_the_plant_are_not_doubted() -> None:
    # A stereo camera reads thin fruit between leaves flat or hollow; strings part their outlines.
    data = os.environ.get("CUCUMBERVISION_DATA")
    if data is None:
        pytest.skip("CUCUMBERVISION_DATA names no folder of real captures")
    folder = Path(data, "rgbd", "cucumber_d435")
    reading = ReadOptions(intrinsics=folder / "intrinsics.json")
    results = measure(folder / "on_plant", options=MeasureOptions("models", reading=reading))
    assert len(results.fruit) >= 17
    # One detection is no fruit: an outline beside anything at its depth.
    others = NO_DEPTH - {Flag.DEPTH_SPARSE}
    assert sum(not others.isdisjoint(item.flags) for item in results.fruit) <= 1
    # Two at the edge of one picture have depth on a fifth of them, and on nothing.
    sparse = [item for item in results.fruit if Flag.DEPTH_SPARSE in item.flags]
    assert len(sparse) <= 2
    assert all((item.fill or 0.0) < 0.25 for item in sparse)


def test_an_outline_that_jumps_ends_early_or_is_loose_is_told() -> None:
    capture = capsule_capture(lying(0.16, distance_m=0.5))
    mask = capture.masks[0]
    rows, columns, kernel = *np.nonzero(mask), np.ones((13, 13), np.uint8)
    wide, narrow = (change(mask.astype(np.uint8), kernel) > 0 for change in (cv2.dilate, cv2.erode))
    cut, stray, stem = mask.copy(), mask.copy(), mask.copy()
    cut[:, columns.min() + np.ptp(columns) * 6 // 10 :] = False
    middle = int(rows.mean())
    stray[middle - 8 : middle + 8, columns.max() + 80 : columns.max() + 100] = True
    stem[middle - 3 : middle + 4, columns.max() : columns.max() + 40] = True
    stub, beside = mask.copy(), mask.copy()
    stub[middle - 4 : middle + 5, columns.max() - 1 : columns.max() + 11] = True
    beside[middle + 60 : middle + 70, 310:330] = True
    assert doubts(capture) == ()
    assert doubts(capture, wide) == (Flag.DEPTH_UNALIGNED,)
    assert doubts(capture, narrow) == doubts(capture, cut) == (Flag.OUTLINE_SHORT,)
    gap, thin = Flag.DEPTH_GAP, Flag.OUTLINE_STEM
    for outline, flag in ((stray, gap), (beside, gap), (stem, thin), (stub, thin)):
        more = with_depth(capture, np.where(outline & ~mask, 0.48, capture.depth_m))
        assert doubts(more, outline) == (flag,)
    for noise_m in (0.0, 0.002):
        one_m = np.random.default_rng(2).normal(0.4903, noise_m, mask.shape).round(3)
        single = with_depth(capture, np.where(mask, one_m, capture.depth_m))
        assert doubts(single) == (Flag.DEPTH_COARSE,)
    bench = with_depth(capture, np.minimum(capture.depth_m, 0.52))
    assert (doubts(bench), doubts(bench, wide)) == ((), (Flag.DEPTH_UNALIGNED,))
    assert [is_lower_bound(f) for f in ([Flag.OUTLINE_SHORT], [Flag.END_HIDDEN, thin])] == [1, 0]


@pytest.mark.parametrize(("share", "side_px"), [(0.15, 3), (0.3, 5)])
def test_depth_whose_holes_were_averaged_in_is_flagged(share: float, side_px: int) -> None:
    capture = capsule_capture(lying(0.16, distance_m=0.5))
    is_hole = np.random.default_rng(3).random(capture.depth_m.shape) < share
    averaged_m = np.asarray(cv2.blur(np.where(is_hole, 0, capture.depth_m), (side_px,) * 2), float)
    assert Flag.DEPTH_UNALIGNED in doubts(with_depth(capture, averaged_m))


@pytest.mark.parametrize("tilt_deg", [-30, 20, 30, 40])
def test_a_piece_of_a_neighbour_in_the_outline_is_a_gap(tilt_deg: int) -> None:
    along = np.array([np.cos(np.deg2rad(tilt_deg)), 0.0, np.sin(np.deg2rad(tilt_deg))])
    first, last = (tuple(reach_m * along + (0.0, 0.0, 0.5)) for reach_m in (0.1, 0.14))
    capture = capsule_capture(lying(0.16, tilt_deg=tilt_deg), Capsule(first, last, 0.015))
    fruit, neighbour = capture.masks
    middle = int(np.median(np.nonzero(neighbour)[1]))
    neighbour[:, middle:] = neighbour[:, : middle - 12] = False
    assert doubts(capture, fruit | neighbour) == (Flag.DEPTH_GAP,)


def test_a_speck_far_off_an_outline_is_no_part_of_it() -> None:
    capture = capsule_capture(lying(0.16))
    mask = capture.masks[0].copy()
    rows, columns = np.nonzero(mask)
    mask[int(rows.mean()) : int(rows.mean()) + 3, columns.max() + 80] = True
    assert doubts(capture, mask) == ()


def is_elsewhere(capture: Capture) -> bool:
    return Flag.DEPTH_UNALIGNED in doubts(capture)


@pytest.mark.parametrize("moved_px", [(0, 16), (0, -24), (14, 14)])
def test_depth_that_lies_beside_its_outline_is_unaligned(moved_px: tuple[int, int]) -> None:
    capture = capsule_capture(lying(0.16, distance_m=0.5))
    for shift, moved in ((moved_px, True), ((2, 2), False)):
        shifted = with_depth(capture, np.roll(capture.depth_m, shift, axis=(1, 0)))
        assert is_elsewhere(shifted) == moved


@pytest.mark.parametrize("rise_m", [0.0, 0.08, 0.16])
def test_moved_depth_is_told_where_the_camera_looks_at_a_bench_at_an_angle(rise_m: float) -> None:
    # A fruit of 0.1 m between its ends' centres, and the bench it lies on: z = 0.518 + slope * x.
    lying_on = Capsule((-0.05, 0.0, 0.5 - rise_m / 2), (0.05, 0.0, 0.5 + rise_m / 2), 0.018)
    capture = capsule_capture(lying_on)
    x = (np.arange(CAMERA.width) - CAMERA.cx_px) / CAMERA.fx_px
    bench_m = np.broadcast_to(0.518 / (1 - rise_m / 0.1 * x), capture.depth_m.shape)
    capture = with_depth(
        capture, np.where(capture.masks[0], np.minimum(capture.depth_m, bench_m), bench_m)
    )
    for moved_px in (0, 18, -18):
        moved = with_depth(capture, np.roll(capture.depth_m, moved_px, axis=0))
        assert is_elsewhere(moved) == bool(moved_px)


def test_depth_of_a_wider_camera_of_the_same_size_is_unaligned() -> None:
    # As a D435 writes depth that nobody aligned: 0.69 of colour's focal length.
    wider = replace(CAMERA, fx_px=0.69 * 462, fy_px=0.69 * 462)
    for across_m, down_m in ((0.03, 0.05), (0.03, 0.06), (0.0, 0.0)):
        fruit = lying(0.16, across_m=across_m, down_m=down_m)
        capture = capsule_capture(fruit)
        unaligned = with_depth(capture, capsule_capture(fruit, camera=wider).depth_m)
        assert not is_elsewhere(capture)
        assert is_elsewhere(unaligned)


def is_coarse(capture: Capture, mask: NDArray[np.bool_] | None = None) -> bool:
    outline = capture.masks[0] if mask is None else mask
    return has_coarse_steps(capture.depth_m, capture.depth_m[outline])


@pytest.mark.parametrize("step_m", [0.01, 0.025, 10 / 255])
def test_depth_in_coarse_steps_is_told_and_gives_no_interval(step_m: float) -> None:
    floor = Capsule((-0.3, 0.14, 0.35), (0.3, 0.14, 0.75), 0.1)  # other depths in the picture
    capture = capsule_capture(lying(0.16, distance_m=0.5), floor)
    fruit = capture.masks[0]
    assert not is_coarse(capture, fruit)
    millimetres = with_depth(capture, np.round(capture.depth_m, 3))
    assert not is_coarse(millimetres, fruit)
    coarse = with_depth(capture, np.floor(capture.depth_m / step_m) * step_m)
    assert is_coarse(coarse, fruit)
    (measured,) = measure(replace(coarse, masks=(fruit,)), instances="dataset").fruit
    assert Flag.DEPTH_COARSE in measured.flags
    assert measured.length is None or measured.length.low_m is None
    assert not measured.at_least


def test_a_picture_of_8_bits_saved_with_16_is_told() -> None:
    capture = capsule_capture(lying(0.16, distance_m=0.5), wall_m=0.8)
    eight_bits = np.floor(255 * capture.depth_m / capture.depth_m.max())
    assert is_coarse(with_depth(capture, 0.001 * eight_bits))
    # A camera that reads so near stores tenths of a millimetre.
    assert not is_coarse(with_depth(capture, np.round(0.3 * capture.depth_m, 4)))
