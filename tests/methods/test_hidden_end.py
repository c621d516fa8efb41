from __future__ import annotations

import numpy as np
import pytest

from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.methods.hidden_end import (
    FARTHEST_M,
    BeyondEnd,
    beyond_ends,
    covered_reach,
    hidden_length,
)
from cucumbervision.methods.m6 import measure_m6
from cucumbervision_lab.scenes.bodies import arc_tube, rotation
from cucumbervision_lab.scenes.scene import Scene, render

CAMERA = Intrinsics(848, 480, 610.0, 610.0, 424.0, 240.0)
AXIS = np.stack([np.linspace(-0.05, 0.05, 60), np.zeros(60), np.full(60, 0.5)], axis=1)


def test_reach_ends_where_the_wall_is_seen_again() -> None:
    depth = np.full((480, 848), 1.0, np.float32)
    depth[:, 480:600] = 0.0  # to x = 175.5 / 610 * 0.5 = 0.144 m nothing is known to be behind
    assert covered_reach(depth, CAMERA, AXIS, -1) == pytest.approx(0.094, abs=0.003)


def test_what_lies_as_far_as_the_fruit_covers_nothing() -> None:
    depth = np.full((480, 848), 0.5, np.float32)
    assert covered_reach(depth, CAMERA, AXIS, -1) == pytest.approx(0.002)
    depth[:] = 0.494  # nearer by more than 5 mm: it does
    assert covered_reach(depth, CAMERA, AXIS, -1) is None


def test_a_leaf_up_to_the_pictures_edge_leaves_the_reach_open() -> None:
    depth = np.full((480, 848), 1.0, np.float32)
    depth[:, 480:] = 0.4
    assert covered_reach(depth, CAMERA, AXIS, -1) is None
    assert covered_reach(np.full((480, 8480), 0.4, np.float32), CAMERA, AXIS, -1) == FARTHEST_M


def test_the_whole_length_lies_between_what_is_seen_and_what_would_be() -> None:
    near, far = hidden_length(0.20, 0.045, 0.02), hidden_length(0.20, 0.045, 0.15)
    assert 0.18 < near.low_m < near.median_m < near.high_m < 0.24
    assert near.high_m - near.low_m < far.high_m - far.low_m
    assert far.high_m < 0.36
    # A thicker fruit is a longer one.
    assert hidden_length(0.10, 0.05, 0.2).median_m > hidden_length(0.10, 0.03, 0.2).median_m


def test_how_much_is_seen_behind_an_end() -> None:
    # A fruit of radius 2 cm at 0.5 m, from column 302 to 546: the last ball's centre is column 522.
    depth, mask = np.full((480, 848), 1.0, np.float32), np.zeros((480, 848), bool)
    mask[216:264, 302:547] = True
    depth[mask] = 0.5
    centres = np.stack([np.linspace(-0.08, 0.08, 17), np.zeros(17), np.full(17, 0.5)], axis=1)
    radii = np.full(17, 0.02)
    first, last = beyond_ends(depth, mask, CAMERA, centres, radii)
    assert first == last == BeyondEnd(covered=False, behind=1.0)
    depth[:240][~mask[:240]] = 0.0  # above the axis nothing is read
    half = beyond_ends(depth, mask, CAMERA, centres, radii)[1]
    assert half.behind == pytest.approx(0.5, abs=0.03)
    depth[~mask] = 0.5  # all round it lie others
    assert beyond_ends(depth, mask, CAMERA, centres, radii)[1] == BeyondEnd(False, 0.0)
    depth[~mask] = 0.4
    assert beyond_ends(depth, mask, CAMERA, centres, radii)[1] == BeyondEnd(True, 0.0)


def test_what_lies_beyond_an_end_outside_the_picture_is_not_known() -> None:
    depth = np.full((480, 848), 0.5, np.float32)
    centres = np.stack([np.linspace(0.0, 0.9, 19), np.zeros(19), np.full(19, 0.5)], axis=1)
    last = beyond_ends(depth, np.ones((480, 848), bool), CAMERA, centres, np.full(19, 0.02))[1]
    assert last == BeyondEnd(covered=False, behind=0.0)


def test_a_covered_end_gets_an_interval_and_seen_ends_none() -> None:
    tube = arc_tube(0.24, 0.021).moved(rotation(), (0.0, 0.0, 0.55))
    view = render(Scene.of(tube, backdrop_m=1.1), CAMERA)
    depth, mask = view.depth_m.astype(np.float32), view.mask(0)
    whole = measure_m6(depth, mask, CAMERA).fit
    assert whole is not None
    assert whole.hidden_length is None
    # The fruit spans 424 +- 133 columns; a leaf covers all from 490 to 599.
    depth[:, 490:600] = 0.45
    mask[:, 490:600] = False
    fit = measure_m6(depth, mask, CAMERA).fit
    assert fit is not None
    assert fit.hidden_length is not None
    assert fit.hidden_length.seen_m == fit.traits.lengths.centreline_m < 0.20
    assert fit.hidden_length.low_m < 0.24 < fit.hidden_length.high_m
    # With depth on a third of it there is none.
    depth[mask & (np.indices(mask.shape)[0] % 3 > 0)] = 0
    sparse = measure_m6(depth, mask, CAMERA).fit
    assert sparse is not None
    assert sparse.ends_seen.count(False) == 1
    assert sparse.hidden_length is None
