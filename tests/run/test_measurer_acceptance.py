from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cucumbervision.capture.frames import Capture
from cucumbervision.capture.readers import open_source
from cucumbervision.capture.source import example_captures
from cucumbervision.crop.profiles import load_profile
from cucumbervision.fruit.instance import Instance
from cucumbervision.methods.flags import Flag
from cucumbervision.methods.result import (
    Choice,
    Fruit,
    Length,
    LengthKind,
    Measurement,
    MethodName,
    Reason,
)
from cucumbervision.run.measurer import Measurer, accepted_fruit, with_unit_doubts
from cucumbervision.run.options import MeasureOptions

LENGTHS_M, DIAMETERS_M = (0.05, 0.80), (0.012, 0.07)


def scaled(factor: float, name: str = "simulated-row-a") -> Capture:
    """A bundled capture whose depth is read in steps that many times as large."""
    capture = next(iter(open_source(example_captures() / name).refs())).load()
    far = capture.depth_m * np.float32(factor)
    return replace(capture, depth_m=np.where(far < 5, far, 0).astype(np.float32))


def test_a_cucumber_of_74_cm_is_too_thick_and_says_so() -> None:
    # The third is 14.9 cm long and 3.3 cm thick: in steps of 0.2 mm read as 1 mm, 74 and 16.
    options = MeasureOptions(instances="dataset")
    wide = replace(options, accepted_m=(0.0, 9.0), accepted_diameter_m=(0.0, 9.0))
    length = Measurer(wide).measure(scaled(5)).fruit[2].length
    assert length is not None
    assert length.value_m == pytest.approx(0.74, abs=0.01)
    fruit = Measurer(options).measure(scaled(5)).fruit
    assert [one.length for one in fruit] == [None, None, None]
    assert str(fruit[2].reason) == "implausible-diameter"
    assert fruit[2].fallback[-1] == "M6:out-of-range"
    assert all(Flag.DEPTH_UNIT in one.flags for one in fruit)


def raw(length_m: float, width_m: float, reason: Reason) -> tuple[Fruit, Capture]:
    """A fruit that M5 measured, M6's tube having failed, on a bar 1 m away: 1 px is 2 mm."""
    capture = scaled(1)
    pixels = round(length_m * width_m / 0.002**2)
    mask = np.zeros(capture.depth_m.shape, bool)
    mask.flat[:pixels] = True
    camera = replace(capture.intrinsics, fx_px=500.0, fy_px=500.0)
    five = Measurement(MethodName.M5, length_m, LengthKind.SURFACE_ARC)
    six = Measurement(MethodName.M6, reason=reason)
    fruit = Fruit(
        Instance(np.array([0.0, 0, 9, 9])), {MethodName.M5: five, MethodName.M6: six}, five,
        Choice.DENSE_MASK, mask=mask, length=Length(length_m, LengthKind.SURFACE_ARC),
        distance_m=1.0,
    )  # fmt: skip
    return fruit, replace(capture, intrinsics=camera)


@pytest.mark.parametrize(
    ("length_m", "width_m", "reason", "said", "large"),
    [
        (0.60, 0.065, Reason.OUT_OF_RANGE, Choice.DENSE_MASK, False),
        (0.60, 0.075, Reason.OUT_OF_RANGE, Choice.IMPLAUSIBLE_DIAMETER, True),
        # A mask's width counts only where it is as good as a tube.
        (0.60, 0.075, Reason.TOO_FEW_POINTS, Choice.DENSE_MASK, False),
        (0.30, 0.010, Reason.OUT_OF_RANGE, Choice.IMPLAUSIBLE_DIAMETER, False),
        (0.90, 0.040, Reason.NOT_A_TUBE, Choice.IMPLAUSIBLE, True),
        (0.04, 0.040, Reason.NOT_A_TUBE, Choice.IMPLAUSIBLE, False),
    ],
)
def test_what_is_refused(
    length_m: float, width_m: float, reason: Reason, said: Choice, large: bool
) -> None:
    fruit, capture = raw(length_m, width_m, reason)
    done = accepted_fruit(fruit, LENGTHS_M, DIAMETERS_M, capture.intrinsics)
    assert done.reason is said
    assert (done.length is None) == (done.selected is None) == (said is not Choice.DENSE_MASK)
    assert (Flag.DEPTH_UNIT in done.flags) == large


def test_half_a_picture_that_is_too_large_casts_doubt_on_the_rest() -> None:
    fruit, capture = raw(0.30, 0.04, Reason.NOT_A_TUBE)
    large = accepted_fruit(fruit, LENGTHS_M, (0.0, 0.01), capture.intrinsics)
    assert large.length is not None  # no tube: nothing is known of its diameter
    large = accepted_fruit(fruit, (0.0, 0.20), DIAMETERS_M, capture.intrinsics)
    unmeasured = replace(fruit, length=None, reason=Choice.NO_DEPTH)
    doubted = with_unit_doubts([large, fruit, unmeasured])
    assert [Flag.DEPTH_UNIT in one.flags for one in doubted] == [True, True, False]
    assert doubted[1].length is not None
    assert with_unit_doubts([large, fruit, fruit]) == (large, fruit, fruit)
    assert with_unit_doubts([]) == ()


@pytest.mark.parametrize("name", ["aubergine", "courgette", "green-bean", "long-cucumber"])
def test_a_crop_five_times_as_large_is_none(name: str) -> None:
    usual_cm = {"aubergine": 6.0, "courgette": 4.5, "green-bean": 0.9, "long-cucumber": 4.5}[name]
    least, most = load_profile(name).accepted_diameter_m
    assert least < usual_cm / 100 < most < 5 * usual_cm / 100
