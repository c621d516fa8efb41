"""Drawn fruit behind leaves and strings, and end to end; what is one fruit is known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from cucumbervision.instances.instance import Instance
from cucumbervision.instances.masks import box_of_mask
from cucumbervision.perception.detectors import each_fruit_once
from cucumbervision.perception.pieces import join_pieces_by_depth

HEIGHT, WIDTH, GIRTH = 300, 480, 40
Mask = NDArray[np.bool_]
FRUIT_M, LEAF_M, WALL_M = 0.60, 0.55, 0.90


def capsule(*points: tuple[float, float], thick: int = GIRTH) -> Mask:
    """A round line's pixels: fruit with round ends."""
    canvas = np.zeros((HEIGHT, WIDTH), np.uint8)
    cv2.polylines(canvas, [np.rint(points).astype(np.int32)], False, 255, thick)
    return np.asarray(canvas > 0)


def strip(u: float, wide: float, turn_deg: float = 0.0) -> Mask:
    """What stands before the fruit: an upright strip, turned."""
    y, x = np.indices((HEIGHT, WIDTH))
    turn = np.deg2rad(turn_deg)
    across = (x - u) * np.cos(turn) + (y - HEIGHT / 2) * np.sin(turn)
    return np.asarray(np.abs(across) <= wide / 2)


def arc(bend_deg: float) -> Mask:
    """A fruit of 8 diameters, bent by so many degrees in all."""
    if not bend_deg:
        return capsule((100, 150), (380, 150))
    radius = 280 / np.deg2rad(bend_deg)
    at = np.deg2rad(np.linspace(-bend_deg / 2, bend_deg / 2, 40))
    u, v = 240 + radius * np.sin(at), 120 + radius * (1 - np.cos(at))
    return capsule(*zip(u.tolist(), v.tolist(), strict=True))


class Drawing:
    """Fruit before a wall and something before them, as depth and finds."""

    def __init__(self, *fruit: Mask, front: Mask | None = None, front_m: float = LEAF_M) -> None:
        covered = np.zeros((HEIGHT, WIDTH), bool) if front is None else front
        self.depth_m = np.full((HEIGHT, WIDTH), WALL_M, np.float32)
        for mask in fruit:
            self.depth_m[mask] = FRUIT_M
        self.depth_m[covered] = front_m
        self.finds: list[Instance] = []
        for mask in fruit:
            count, labels = cv2.connectedComponents((mask & ~covered).astype(np.uint8))
            for k in range(1, count):
                part = np.asarray(labels) == k
                score = 0.9 - 0.1 * len(self.finds)
                self.finds.append(Instance(box_of_mask(part), score, detector_mask=part))

    def joined(self) -> int:
        """How many fruit there are after joining."""
        return len(join_pieces_by_depth(self.finds, [], self.depth_m))


@pytest.mark.parametrize(
    ("wide", "turn_deg", "bend_deg"),
    [(6, 0, 50), (30, 0, 50), *((w, t, b) for w, t in ((30, 30), (70, 15)) for b in (0, 25))],
)
def test_what_a_leaf_or_string_parts_is_one_fruit(
    wide: float, turn_deg: float, bend_deg: float
) -> None:
    drawing = Drawing(arc(bend_deg), front=strip(225, wide, turn_deg))
    assert len(drawing.finds) == 2
    assert drawing.joined() == 1


def test_a_fruit_in_three_parts_is_one_and_has_all_their_pixels() -> None:
    drawing = Drawing(arc(0), front=strip(180, 20) | strip(290, 30))
    (one,) = join_pieces_by_depth(drawing.finds[::-1], [], drawing.depth_m)
    assert one.confidence == 0.9
    assert one.detector_mask is not None
    assert (one.detector_mask == (arc(0) & ~strip(180, 20) & ~strip(290, 30))).all()
    assert one.box.tolist() == box_of_mask(arc(0)).tolist()


@pytest.mark.parametrize("gap_px", [0, 5, 20, 60])
def test_two_fruit_end_to_end_stay_two(gap_px: int) -> None:
    # Round ends reach half a diameter beyond the line's ends.
    first = capsule((60, 150), (200, 150))
    second = capsule((200 + GIRTH + 1 + gap_px, 150), (400, 150))
    assert Drawing(first, second).joined() == 2


@pytest.mark.parametrize("wide", [6, 12])
def test_two_fruit_end_to_end_behind_a_string_stay_two(wide: int) -> None:
    first, second = capsule((60, 150), (200, 150)), capsule((250, 150), (400, 150))
    assert Drawing(first, second, front=strip(225, wide)).joined() == 2


def test_two_fruit_far_apart_behind_one_leaf_stay_two() -> None:
    drawing = Drawing(arc(0), front=strip(240, 110))
    assert drawing.joined() == 2


def test_cut_fruit_with_nothing_before_the_gap_stay_two() -> None:
    # Two sawn pieces in line: only depth tells that the gap is empty.
    drawing = Drawing(arc(0), front=strip(240, 40), front_m=WALL_M)
    assert drawing.joined() == 2


@pytest.mark.parametrize(
    "second",
    [
        capsule((260, 190), (400, 190)),  # beside the first one's line
        capsule((260, 150), (370, 250)),  # turned by 42 degrees
        capsule((260, 150), (400, 150), thick=22),  # thinner
    ],
)
def test_other_fruit_behind_the_same_leaf_stay_two(second: Mask) -> None:
    drawing = Drawing(capsule((60, 150), (225, 150)), second, front=strip(242, 60))
    assert len(drawing.finds) == 2
    assert drawing.joined() == 2


def test_a_weak_detection_continues_a_fruit_but_is_none_of_its_own() -> None:
    drawing = Drawing(arc(0), front=strip(225, 6))
    upper, lower = drawing.finds
    alone = capsule((60, 250), (200, 250))
    drawing.depth_m[alone] = FRUIT_M
    weak = [lower, Instance(box_of_mask(alone), 0.1, detector_mask=alone)]
    (one,) = join_pieces_by_depth([upper], weak, drawing.depth_m)
    assert one.confidence == upper.confidence
    # The sections end within the round tip.
    assert one.box == pytest.approx(box_of_mask(arc(0)), abs=GIRTH / 4)


def test_a_weak_detection_around_a_fruit_gives_what_lies_on_its_line() -> None:
    # The lower half was seen together with the leaf behind it, twice as wide.
    whole = arc(0)
    upper = whole & (np.indices(whole.shape)[1] < 225)
    fat = upper | capsule((225, 160), (360, 160), thick=2 * GIRTH)
    found, weak = (Instance(box_of_mask(m), 0.5, detector_mask=m) for m in (upper, fat))
    depth_m = np.where(whole | fat, FRUIT_M, WALL_M).astype(np.float32)
    (one,) = join_pieces_by_depth([found], [weak], depth_m)
    assert one.detector_mask is not None
    beyond = one.detector_mask[:, 300]
    assert np.flatnonzero(beyond)[[0, -1]] == pytest.approx([150, 150], abs=0.8 * GIRTH)
    assert one.box[2] > 370


def test_parts_at_other_distances_are_not_joined() -> None:
    drawing = Drawing(arc(0), front=strip(225, 30))
    drawing.depth_m[:, 240:][arc(0)[:, 240:]] = FRUIT_M + 0.05
    assert drawing.joined() == 2


def test_finds_without_masks_are_left_as_they_are() -> None:
    boxes = [Instance(np.array([x, 0.0, x + 90, 20])) for x in (0, 100)]
    depth_m = np.full((HEIGHT, WIDTH), FRUIT_M, np.float32)
    assert join_pieces_by_depth(boxes, [], depth_m) == tuple(boxes)
    assert join_pieces_by_depth([], [], depth_m) == ()


def test_a_joined_fruit_takes_the_keypoints_of_the_pose_over_the_whole() -> None:
    drawing = Drawing(arc(0), front=strip(225, 30))
    line = np.column_stack([np.linspace(85, 395, 5), np.full(5, 150.0), np.ones(5)])
    pose = Instance(box_of_mask(arc(0)), 0.8, keypoints=line)
    (one,) = each_fruit_once(drawing.finds, [pose], drawing.depth_m)
    assert one.keypoints is line
