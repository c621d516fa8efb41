from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from cucumbervision.capture.frames import Capture
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.fruit.instance import Instance, MaskSource
from cucumbervision.methods.result import MethodName
from cucumbervision.methods.selector import end_doubts, measure_fruit

BLOSSOM, STEM = 40, 240  # the keypoints' outermost columns: 200 px apart


def line(visibility: tuple[float, ...] = (1, 1, 1, 1, 1)) -> NDArray[np.float64]:
    u = np.linspace(BLOSSOM, STEM, 5)
    return np.column_stack([u, np.full(5, 60.0), visibility])


def bar(left: int, right: int) -> NDArray[np.bool_]:
    mask = np.zeros((120, 320), bool)
    mask[50:71, left : right + 1] = True
    return mask


def end_flags(mask: NDArray[np.bool_] | None, keypoints: NDArray[np.float64]) -> tuple[str, ...]:
    *hidden, disagree = end_doubts(mask, keypoints)
    return ("end-hidden",) * any(hidden) + ("ends-disagree",) * disagree


@pytest.mark.parametrize(
    ("left", "right", "flags"),
    [
        (40, 240, ()),
        (59, 240, ()),  # ends 19 of 200 px before the keypoint
        (61, 240, ("end-hidden",)),
        (40, 219, ("end-hidden",)),
        (150, 240, ("end-hidden",)),  # nothing at all near the blossom end
        (21, 259, ()),
        (19, 240, ("ends-disagree",)),
        (40, 261, ("ends-disagree",)),
        (61, 261, ("end-hidden", "ends-disagree")),
    ],
)
def test_mask_against_keypoints(left: int, right: int, flags: tuple[str, ...]) -> None:
    assert end_flags(bar(left, right), line()) == flags
    # The same the other way round, and upright.
    mirrored = line()[::-1]
    assert end_flags(bar(left, right), mirrored) == flags
    upright = line()[:, [1, 0, 2]]
    assert end_flags(bar(left, right).T, upright) == flags


@pytest.mark.parametrize(
    ("visibility", "flags"),
    [
        ((0.4, 1, 1, 1, 0.4), ()),
        ((0.39, 1, 1, 1, 1), ("end-hidden",)),
        ((1, 1, 1, 1, 0.2), ("end-hidden",)),
        ((0, 0, 0, 0, 0), ()),  # labelled nowhere: nothing is known
    ],
)
def test_visibility_of_the_ends(visibility: tuple[float, ...], flags: tuple[str, ...]) -> None:
    assert end_flags(bar(40, 240), line(visibility)) == flags
    assert end_flags(None, line(visibility)) == flags


def test_keypoints_on_one_spot_are_no_line() -> None:
    spot = np.column_stack([np.full((5, 2), 60.0), np.ones(5)])
    assert end_flags(bar(40, 240), spot) == ()


def test_a_hook_is_judged_by_its_own_end() -> None:
    # A half circle of 100 px radius: the other end lies ahead of neither.
    y, x = np.indices((260, 260))
    far = np.hypot(x - 130, y - 130)
    mask = (np.abs(far - 100) <= 12) & (y <= 130)
    angle = np.linspace(0, np.pi, 5)
    points = np.column_stack([130 + 100 * np.cos(angle), 130 - 100 * np.sin(angle), np.ones(5)])
    assert end_flags(mask, points) == ()
    assert end_flags(mask & (y <= 85), points) == ("end-hidden",)


def test_a_row_says_that_an_end_is_hidden_once() -> None:
    # Half of a fruit behind a leaf: the depth ends with the mask, the keypoints go on.
    depth = np.zeros((720, 1280), np.float32)
    depth[340:381, 440:641] = 0.5
    camera = Intrinsics(1280, 720, 910.0, 910.0, 640.0, 360.0)
    capture = Capture(np.zeros((720, 1280, 3), np.uint8), depth, camera, "leaf")
    keypoints = np.array([[u, 360.0, 1.0] for u in (440, 540, 640, 740, 840)])
    box = np.array([439.5, 339.5, 640.5, 380.5])
    instance = Instance(box, mask=depth > 0, mask_source=MaskSource.SAM)
    methods = (MethodName.M3, MethodName.M5)
    assert "end-hidden" not in measure_fruit(capture, instance, methods).flags
    hinted = measure_fruit(capture, replace(instance, keypoints=keypoints), methods)
    assert hinted.flags.count("end-hidden") == 1
    both = measure_fruit(capture, replace(instance, keypoints=keypoints))
    assert both.flags.count("end-hidden") == 1
