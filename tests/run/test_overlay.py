from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cucumbervision.capture.frames import Capture
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.fruit.instance import Instance, MaskSource
from cucumbervision.methods.flags import Flag
from cucumbervision.methods.result import Choice, Length, LengthDefinition, MethodName
from cucumbervision.methods.selector import measure_fruit
from cucumbervision.run.overlay import COLORS, _label, draw_overlay


@pytest.fixture
def capture(camera: Intrinsics) -> Capture:
    depth = np.full((720, 1280), 0.455, np.float32)
    return Capture(np.full((720, 1280, 3), 90, np.uint8), depth, camera, "plate")


@pytest.fixture
def instance() -> Instance:
    mask = np.zeros((720, 1280), bool)
    mask[340:380, 440:840] = True
    return Instance(np.array([439.5, 339.5, 839.5, 379.5]), mask=mask, mask_source=MaskSource.SAM)


def test_drawing_leaves_the_capture_as_it_is(capture: Capture, instance: Instance) -> None:
    before = capture.color.copy()
    picture = draw_overlay(capture, [measure_fruit(capture, instance)])
    assert (capture.color == before).all()
    assert picture.shape == before.shape


def test_the_mask_is_tinted_and_the_rest_is_not(capture: Capture, instance: Instance) -> None:
    picture = draw_overlay(capture, [measure_fruit(capture, instance)])
    by_hand = [int(0.7 * 90 + 0.3 * c) for c in COLORS[0]]
    assert picture[345, 500].tolist() == by_hand
    assert picture[200, 1200].tolist() == [90, 90, 90]


def test_the_measured_line_runs_along_the_middle(capture: Capture, instance: Instance) -> None:
    picture = draw_overlay(capture, [measure_fruit(capture, instance)])
    assert picture[360, 640].tolist() == [255, 255, 255]


def test_the_scale_bar_is_ten_centimetres_long(capture: Capture, instance: Instance) -> None:
    picture = draw_overlay(capture, [measure_fruit(capture, instance)])
    row = (picture[700] == 255).all(axis=1)
    # 0.10 m at 0.455 m and f = 910 px: 200 px, and the line's own round ends.
    assert row.sum() == pytest.approx(200, abs=8)


def test_a_fruit_that_was_not_measured_is_shown_by_its_box(capture: Capture) -> None:
    empty = replace(capture, depth_m=np.zeros((720, 1280), np.float32))
    fruit = measure_fruit(empty, Instance(np.array([99.5, 99.5, 299.5, 199.5])))
    picture = draw_overlay(empty, [fruit])
    assert tuple(picture[150, 100]) == COLORS[0] or tuple(picture[150, 99]) == COLORS[0]


def test_simulated_captures_say_so(capture: Capture) -> None:
    plain = draw_overlay(capture, [])
    drawn = draw_overlay(replace(capture, simulated=True), [])
    assert (plain[:60] == 90).all()
    assert (drawn[:60, :300] != 90).any()


def test_labels_say_which_length_and_what_runs_on(capture: Capture, instance: Instance) -> None:
    fruit = measure_fruit(capture, instance, [MethodName.M3])
    fruit = replace(fruit, length=Length(0.2104, LengthDefinition.THREAD))
    assert _label(2, fruit) == "2: 21.0 cm thread, M3"
    cut = replace(fruit, flags=(Flag.CUT_BY_FRAME,))
    assert _label(2, cut) == "2: at least 21.0 cm thread, M3"
    nothing = replace(fruit, length=None, reason=Choice.NO_DEPTH)
    assert _label(1, nothing) == "1: not measured (no-depth)"
