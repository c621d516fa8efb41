from __future__ import annotations

import numpy as np
import pytest

from cucumbervision.capture.frames import median_depth
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.measurement.m6 import measure_m6
from cucumbervision.measurement.result import Flag, Reason
from cucumbervision.measurement.views import FruitView, measure_views
from cucumbervision_lab.synthesis.bodies import Tube, arc_tube, rotation
from cucumbervision_lab.synthesis.depth_camera import D4xx, sense
from cucumbervision_lab.synthesis.scene import Scene, render

CAMERA = Intrinsics(848, 480, 610.0, 610.0, 424.0, 240.0)


def seen_from(tube: Tube, along_m: float, place_off_m: float = 0.0, seed: int = 0) -> FruitView:
    scene = Scene.of(tube.moved(np.eye(3), (-along_m, 0, 0)), backdrop_m=1.1)
    depth = median_depth(sense(scene, D4xx.like(CAMERA), np.random.default_rng(seed)))
    pose = np.eye(4)
    pose[0, 3] = along_m + place_off_m
    return FruitView(depth, render(scene, CAMERA).mask(0), CAMERA, pose)


def test_two_stops_give_one_tube_though_their_places_are_off() -> None:
    tube = arc_tube(0.22, 0.018, 0.4).moved(rotation(75, 30), (0.0, 0.0, 0.6))
    views = [seen_from(tube, 0.0), seen_from(tube, 0.25, 0.03, seed=1)]
    joint = measure_views(views)
    found = joint.measurement
    assert found.fit is not None
    assert found.length_m == pytest.approx(0.22, rel=0.02)
    alone = measure_m6(views[0].depth_m, views[0].mask, CAMERA).fit
    assert alone is not None
    assert found.fit.centreline_sd_m < alone.centreline_sd_m
    # The second camera is 0.25 m to the right of the first, not 0.28 m as it was told.
    second = joint.poses[1] @ np.linalg.inv(joint.poses[0])
    assert second[:3, 3] == pytest.approx([-0.25, 0.0, 0.0], abs=0.01)


def test_views_from_one_place_are_one_view() -> None:
    tube = arc_tube(0.20, 0.018).moved(rotation(80), (0.0, 0.0, 0.6))
    view = seen_from(tube, 0.0)
    alone = measure_m6(view.depth_m, view.mask, CAMERA)
    joint = measure_views([view, view])
    assert joint.measurement.length_m == alone.length_m
    assert len(joint.poses) == 1


def test_ends_that_different_views_show_count_together() -> None:
    tube = arc_tube(0.22, 0.018).moved(rotation(80, 10), (0.0, 0.0, 0.6))
    views = []
    for along_m, rows in ((0.0, slice(0, 190)), (0.25, slice(300, 480))):
        view = seen_from(tube, along_m)
        view.depth_m[rows] = 0.45
        view.mask[rows] = False
        views.append(view)
    alone = [measure_m6(view.depth_m, view.mask, CAMERA) for view in views]
    assert all(one.fit is not None and Flag.END_HIDDEN in one.fit.flags for one in alone)
    found = measure_views(views).measurement
    assert found.fit is not None
    assert found.fit.ends_seen == (True, True)
    best = max(one.length_m or 0.0 for one in alone)
    assert abs((found.length_m or 0.0) - 0.22) < 0.5 * abs(best - 0.22)


def test_nothing_seen_has_a_reason() -> None:
    blank = np.zeros((480, 848), np.float32)
    view = FruitView(blank, blank > 0, CAMERA, np.eye(4))
    assert measure_views([view]).measurement.reason is Reason.TOO_FEW_POINTS
