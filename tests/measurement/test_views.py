from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from cucumbervision.capture.frames import Capture, median_depth
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.instances.instance import Instance
from cucumbervision.instances.masks import box_of_mask
from cucumbervision.measurement.intervals import IntervalModels
from cucumbervision.measurement.result import Choice, LengthDefinition, MethodName
from cucumbervision.measurement.selector import measure_fruit
from cucumbervision.measurement.views import FruitView, measure_views
from cucumbervision_lab.synthesis.bodies import Tube, arc_tube, rotation
from cucumbervision_lab.synthesis.depth_camera import D4xx, sense
from cucumbervision_lab.synthesis.scene import Scene, render

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from cucumbervision.measurement.result import Fruit

CAMERA = Intrinsics(848, 480, 610.0, 610.0, 424.0, 240.0)


def seen_from(tube: Tube, along_m: float, place_off_m: float = 0.0, seed: int = 0) -> FruitView:
    scene = Scene.of(tube.moved(np.eye(3), (-along_m, 0, 0)), backdrop_m=1.1)
    depth = median_depth(sense(scene, D4xx.like(CAMERA), np.random.default_rng(seed)))
    pose = np.eye(4)
    pose[0, 3] = along_m + place_off_m
    return view_of(depth, render(scene, CAMERA).mask(0), pose)


def view_of(
    depth_m: NDArray[np.float32], mask: NDArray[np.bool_], pose: NDArray[np.float64]
) -> FruitView:
    capture = Capture(np.zeros((480, 848, 3), np.uint8), depth_m, CAMERA, "drawn")
    box = box_of_mask(mask) if mask.any() else np.array([0.0, 0.0, 1.0, 1.0])
    return FruitView(capture, Instance(box, mask=mask), pose)


def alone_of(view: FruitView) -> Fruit:
    return measure_fruit(view.capture, view.instance, (MethodName.M6,))


def test_two_stops_give_one_tube_though_their_places_are_off() -> None:
    tube = arc_tube(0.22, 0.018, 0.4).moved(rotation(75, 30), (0.0, 0.0, 0.6))
    views = [seen_from(tube, 0.0), seen_from(tube, 0.25, 0.03, seed=1)]
    joint = measure_views(views, LengthDefinition.CENTRELINE)
    assert joint is not None
    assert joint.fruit.fit is not None
    assert joint.fruit.reason is Choice.SEVERAL_VIEWS
    length, alone = joint.fruit.length, alone_of(views[0])
    assert length is not None
    assert length.low_m is not None
    assert length.high_m is not None
    assert length.value_m == pytest.approx(0.22, rel=0.02)
    assert length.low_m < 0.22 < length.high_m
    assert alone.fit is not None
    assert joint.fruit.fit.centreline_sd_m < alone.fit.centreline_sd_m
    # The second camera is 0.25 m to the right of the first, not 0.28 m as it was told.
    second = joint.poses[1] @ np.linalg.inv(joint.poses[0])
    assert second[:3, 3] == pytest.approx([-0.25, 0.0, 0.0], abs=0.01)


def test_the_intervals_of_other_models_are_theirs() -> None:
    tube = arc_tube(0.22, 0.018, 0.4).moved(rotation(75, 30), (0.0, 0.0, 0.6))
    views = [seen_from(tube, 0.0), seen_from(tube, 0.25, seed=1)]
    joint = measure_views(views, models=IntervalModels(0.9, {}, 0))
    assert joint is not None
    assert joint.fruit.length is not None
    assert joint.fruit.length.low_m is None


def test_views_from_one_place_are_one_view() -> None:
    view = seen_from(arc_tube(0.20, 0.018).moved(rotation(80), (0.0, 0.0, 0.6)), 0.0)
    joint = measure_views([view, view])
    assert joint is not None
    assert len(joint.poses) == 1
    assert joint.fruit.length == alone_of(view).length


@pytest.mark.parametrize("nearer_first", [True, False])
def test_a_view_with_hardly_any_depth_is_left_out_beside_another(nearer_first: bool) -> None:
    tube = arc_tube(0.22, 0.018).moved(rotation(75, 30), (0.0, 0.0, 0.6))
    sound, near = seen_from(tube, 0.0), seen_from(tube, 0.25, seed=1)
    depth_m = near.capture.depth_m.copy()
    depth_m[np.array(near.instance.mask) & (np.indices(depth_m.shape).sum(axis=0) % 5 > 0)] = 0
    sparse = view_of(depth_m, np.array(near.instance.mask), near.pose)
    views = [sparse, sound] if nearer_first else [sound, sparse]
    joint = measure_views(views)
    assert joint is not None
    assert list(joint.poses) == [int(nearer_first)]
    assert joint.fruit.length == alone_of(sound).length


def with_rows_hidden(view: FruitView, rows: slice) -> FruitView:
    """Return a view of which a leaf at 45 cm covers some rows."""
    mask, depth_m = np.array(view.instance.mask), view.capture.depth_m.copy()
    depth_m[rows], mask[rows] = 0.45, False
    return view_of(depth_m, mask, view.pose)


def test_ends_that_different_views_show_count_together() -> None:
    tube = arc_tube(0.22, 0.018).moved(rotation(80, 10), (0.0, 0.0, 0.6))
    rows = {0.0: slice(0, 190), 0.25: slice(300, 480)}
    views = [with_rows_hidden(seen_from(tube, at_m), hidden) for at_m, hidden in rows.items()]
    alone = [alone_of(view) for view in views]
    assert all(one.at_least for one in alone)
    joint = measure_views(views, LengthDefinition.CENTRELINE)
    assert joint is not None
    assert joint.fruit.fit is not None
    assert joint.fruit.length is not None
    assert joint.fruit.fit.ends_seen == (True, True)
    assert not joint.fruit.at_least
    # The two leaves leave a stretch that both views show: nothing is hidden from both.
    assert joint.fruit.fit.hidden_share == pytest.approx(0.0, abs=0.02)
    best = max(one.selected.length_m or 0.0 for one in alone if one.selected)
    assert abs(joint.fruit.length.value_m - 0.22) < 0.6 * abs(best - 0.22)


def test_an_end_that_keypoints_miss_in_every_view_stays_hidden() -> None:
    tube = arc_tube(0.22, 0.018).moved(rotation(80, 10), (0.0, 0.0, 0.6))
    views = [seen_from(tube, at_m) for at_m in (0.0, 0.25)]
    line = np.array([[400.0, v, 0.9] for v in (130, 190, 240, 290, 350)])

    def told(view: FruitView, *seen: float) -> FruitView:
        keypoints = line.copy()
        keypoints[[0, -1], 2] = seen
        return replace(view, instance=replace(view.instance, keypoints=keypoints))

    first_hidden = measure_views([told(views[0], 0.1, 0.9), told(views[1], 0.2, 0.9)])
    each_shows_one = measure_views([told(views[0], 0.1, 0.9), told(views[1], 0.9, 0.1)])
    assert first_hidden is not None
    assert first_hidden.fruit.at_least
    assert each_shows_one is not None
    assert not each_shows_one.fruit.at_least


def test_nothing_seen_is_nothing() -> None:
    blank = np.zeros((480, 848), np.float32)
    assert measure_views([view_of(blank, blank > 0, np.eye(4))]) is None
