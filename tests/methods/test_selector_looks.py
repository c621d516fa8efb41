from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from cucumbervision.capture.frames import Capture
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.fruit.crops import EndCrop, EndLook
from cucumbervision.fruit.instance import Instance, MaskSource
from cucumbervision.fruit.masks import box_of_mask
from cucumbervision.methods import intervals
from cucumbervision.methods.flags import Flag, flag_remarks
from cucumbervision.methods.intervals import (
    LOOKED,
    PERCEIVED,
    REAL_SD,
    Band,
    IntervalModel,
    IntervalModels,
    Trees,
)
from cucumbervision.methods.result import Fruit, MethodName, TubeFit
from cucumbervision.methods.selector import measure_fruit, with_end_looks
from cucumbervision_lab.scenes.bodies import arc_tube, rotation
from cucumbervision_lab.scenes.scene import Scene, render

if TYPE_CHECKING:
    from collections.abc import Sequence

TRUE = EndLook(0.98, 0.01, 0.01, (-0.01, -0.004, 0.0, 0.004, 0.01), 0.5)
COVERED = EndLook(0.15, 0.84, 0.01, (0.0, 0.1, 0.2, 0.3, 0.5), 0.5)
STEM = replace(TRUE, stem=1.0)

_M6 = "M6" + PERCEIVED


def model(key: str, spread: float, low: float = 1.0) -> IntervalModel:
    """An interval that is narrow below and wide above where an end is covered."""
    bands = {"": Band(1.0, 1.0, 500), "0": Band(1.0, 1.0, 500), "1": Band(low, 1.0, 9)}
    trees = Trees(np.log(spread))
    return IntervalModel(key, 0.9, (), trees, trees, bands, (("covered", (0.5,)),))


MODELS = IntervalModels(
    0.9, {_M6: model(_M6, 0.2), _M6 + LOOKED: model(_M6 + LOOKED, 0.02, 20.0)}, 500
)


@pytest.fixture(scope="module")
def capture() -> tuple[Capture, Instance, Instance]:
    """Two drawn fruit of 16 cm, one upright and one lying, half a metre away."""
    camera = Intrinsics(1280, 720, 910.0, 910.0, 640.0, 360.0)
    upright = arc_tube(0.16, 0.018, 0.4).moved(rotation(roll_deg=90), (-0.15, 0, 0.5))
    lying = arc_tube(0.16, 0.018, 0.4).moved(rotation(5), (0.1, 0, 0.5))
    # No depth is read beyond the fruit, so that it does not show their ends to be open.
    scene = render(Scene.of(upright, lying), camera)
    fruit = [
        Instance(box_of_mask(scene.mask(k)), mask=scene.mask(k), mask_source=MaskSource.DETECTOR)
        for k in (0, 1)
    ]
    color = np.zeros((720, 1280, 3), np.uint8)
    return Capture(color, scene.depth_m.astype(np.float32), camera, "drawn"), fruit[0], fruit[1]


@pytest.fixture(autouse=True)
def _models(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(intervals, "shipped_interval_models", lambda: MODELS)


def measured(capture: Capture, *instances: Instance) -> list[Fruit]:
    return [measure_fruit(capture, one, (MethodName.M6,), scale_known=True) for one in instances]


def fit_of(fruit: Fruit) -> TubeFit:
    assert fruit.fit is not None
    return fruit.fit


class Looker:
    """Says of the crops in order what it was told to, and counts its batches."""

    def __init__(self, *looks: EndLook) -> None:
        self.looks, self.batches = looks, []  # type: ignore[var-annotated]

    def __call__(self, crops: Sequence[EndCrop]) -> list[EndLook]:
        self.batches.append(len(crops))
        return list(self.looks[: len(crops)])


def test_all_ends_of_a_capture_are_one_batch(capture: tuple[Capture, Instance, Instance]) -> None:
    picture, *instances = capture
    look = Looker(TRUE, STEM, COVERED, TRUE)
    first, second = with_end_looks(picture, measured(picture, *instances), look)
    assert look.batches == [4]
    assert fit_of(first).looks == (TRUE, STEM)
    assert fit_of(second).looks == (COVERED, TRUE)
    assert first.measurements[MethodName.M6] is first.selected


def test_the_interval_depends_on_the_look(capture: tuple[Capture, Instance, Instance]) -> None:
    picture, upright, _ = capture
    before = measured(picture, upright)
    assert before[0].length is not None
    value = before[0].length.value_m
    assert before[0].length.high_m == pytest.approx(value * np.exp(np.hypot(0.2, 1.6449 * REAL_SD)))
    for end, spread in ((TRUE, 0.02), (COVERED, 20 * 0.02)):
        (after,) = with_end_looks(picture, before, Looker(TRUE, end), scale_known=True)
        assert after.length is not None
        assert after.length.value_m == value
        expected = np.hypot(spread, 1.6449 * REAL_SD)
        assert after.length.high_m == pytest.approx(value * np.exp(expected), rel=1e-3)
        narrow = np.hypot(0.02, 1.6449 * REAL_SD)
        assert after.length.low_m == pytest.approx(value * np.exp(-narrow), rel=1e-3)


def test_a_doubtful_end_is_named_by_its_place(capture: tuple[Capture, Instance, Instance]) -> None:
    picture, upright, lying = capture
    fruit = measured(picture, upright, lying)
    places = []
    for one in fruit:
        ends = picture.intrinsics.project(fit_of(one).traits.axis_m[[0, -1]])
        places.append(ends[0] - ends[1])
    for looks, expected in (((COVERED, TRUE), 1), ((TRUE, COVERED), -1)):
        found = with_end_looks(picture, fruit, Looker(*looks, *looks))
        down, across = expected * places[0][1], expected * places[1][0]
        assert (Flag.LOWER_END in found[0].flags) is bool(down > 0)
        assert (Flag.UPPER_END in found[0].flags) is bool(down < 0)
        assert (Flag.RIGHT_END in found[1].flags) is bool(across > 0)
        assert (Flag.LEFT_END in found[1].flags) is bool(across < 0)
    remarks = flag_remarks("lower-end-doubtful ends-unsure")
    assert remarks == "the lower end may go on behind what covers it"


def test_what_is_a_lower_bound_already_is_not_doubted_again(
    capture: tuple[Capture, Instance, Instance],
) -> None:
    picture, upright, _ = capture
    fruit = [one.flagged(Flag.END_HIDDEN) for one in measured(picture, upright)]
    (found,) = with_end_looks(picture, fruit, Looker(COVERED, COVERED))
    assert found.flags == fruit[0].flags


def test_an_interval_that_was_too_wide_is_given_where_the_look_narrows_it(
    capture: tuple[Capture, Instance, Instance], monkeypatch: pytest.MonkeyPatch
) -> None:
    picture, upright, _ = capture
    wide = IntervalModels(0.9, {**MODELS.models, _M6: model(_M6, 0.99)}, 500)
    monkeypatch.setattr(intervals, "shipped_interval_models", lambda: wide)
    before = measured(picture, upright)
    assert Flag.INTERVAL_TOO_WIDE in before[0].flags
    (found,) = with_end_looks(picture, before, Looker(TRUE, TRUE))
    assert Flag.INTERVAL_TOO_WIDE not in found.flags
    assert found.length is not None
    assert found.length.high_m is not None


@pytest.mark.parametrize("source", [MaskSource.DATASET, MaskSource.HAND])
def test_masks_that_no_network_drew_are_not_looked_at(
    capture: tuple[Capture, Instance, Instance], source: MaskSource
) -> None:
    picture, upright, _ = capture
    fruit = measured(picture, replace(upright, mask_source=source))
    look = Looker(TRUE, TRUE)
    assert with_end_looks(picture, fruit, look) == fruit
    assert look.batches == []
