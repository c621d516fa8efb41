from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cucumbervision.capture.frames import Capture, Stop
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.measurement.result import (
    Fruit,
    Length,
    LengthKind,
    Measurement,
    Method,
    TubeLengths,
)
from cucumbervision.measurement.selector import measure_fruit
from cucumbervision.perception.instances import Instance, MaskSource
from cucumbervision.pipeline.rows import COLUMNS, defused, fruit_row

NAMED_BY_THE_ISSUE = (
    "capture, frame, fruit, score, method, reason, fallback, length_cm, length_kind, "
    "interval_low_cm, interval_high_cm, centreline_cm, thread_cm, chord_cm, "
    "m1_cm, m2_cm, m3_cm, m4_cm, m5_cm, m6_cm"
)


@pytest.fixture
def capture(camera: Intrinsics) -> Capture:
    depth = np.zeros((720, 1280), np.float32)
    depth[340:380, 440:840] = 0.455
    depth[340:350, 440:840] = 0  # a quarter without reading
    color = np.zeros((720, 1280, 3), np.uint8)
    return Capture(color, depth, camera, "plate", frame=17, stop=Stop("3", "left", 1.2, 4))


@pytest.fixture
def instance() -> Instance:
    mask = np.zeros((720, 1280), bool)
    mask[340:380, 440:840] = True
    return Instance(
        np.array([439.5, 339.5, 839.5, 379.5]), 0.91, mask=mask, mask_source=MaskSource.SAM
    )


def test_columns_start_with_the_named_ones_and_are_unique() -> None:
    names = [c.name for c in COLUMNS]
    assert ", ".join(names[:20]) == NAMED_BY_THE_ISSUE
    assert len(set(names)) == len(names)
    assert all(c.unit == "cm" for c in COLUMNS if c.name.endswith("_cm"))


def test_a_measured_fruit_fills_its_row(capture: Capture, instance: Instance) -> None:
    row = fruit_row(capture, 2, measure_fruit(capture, instance))
    assert list(row) == [c.name for c in COLUMNS]
    assert (row["capture"], row["frame"], row["fruit"], row["score"]) == ("plate", 17, 2, 0.91)
    assert row["method"] == "M6"
    assert row["reason"] == "mask-points-ge-100"
    assert row["length_kind"] == "thread"
    assert row["m5_cm"] == pytest.approx(20, rel=0.04)
    assert row["m6_cm"] == row["centreline_cm"] == pytest.approx(20, rel=0.05)
    assert row["length_cm"] == row["thread_cm"] == pytest.approx(21.5, rel=0.08)
    assert row["m4_cm"] is None
    assert row["mask_px"] == 16000
    assert row["fill"] == 0.75
    assert row["distance_cm"] == 45.5
    assert (row["row"], row["side"], row["position_m"], row["step"]) == ("3", "left", 1.2, 4)


def test_a_fruit_that_nothing_measured_has_a_row_too(capture: Capture) -> None:
    nothing = measure_fruit(capture, Instance(np.array([9.5, 9.5, 209.5, 49.5])))
    row = fruit_row(capture, 1, nothing)
    assert row["method"] is None
    assert row["length_cm"] is None
    assert row["reason"] == "no-depth"
    assert row["fallback"] == "M1:no-depth > M2:no-depth"
    assert row["distance_cm"] is None


@pytest.mark.parametrize(
    ("length", "expected"),
    [(Length.THREAD, 22.0), (Length.CENTRELINE, 20.0), (Length.CHORD, 19.0)],
)
def test_a_tube_gives_the_length_that_was_asked(
    capture: Capture, instance: Instance, length: Length, expected: float
) -> None:
    tube = TubeLengths(centreline_m=0.20, thread_m=0.22, chord_m=0.19)
    fitted = Measurement(Method.M6, 0.20, LengthKind.SURFACE_ARC, tube=tube)
    row = fruit_row(capture, 1, Fruit(instance, {Method.M6: fitted}, fitted, "x"), length)
    assert row["length_cm"] == expected
    assert row["length_kind"] == str(length)
    assert (row["centreline_cm"], row["thread_cm"], row["chord_cm"]) == (20.0, 22.0, 19.0)


def test_the_method_named_is_the_one_that_measured(capture: Capture, instance: Instance) -> None:
    few = np.zeros_like(instance.mask)
    few[360, 440:480] = True
    row = fruit_row(capture, 1, measure_fruit(capture, replace(instance, mask=few)))
    assert row["method"] == "M2"
    assert row["reason"] == "mask-points-lt-100"
    assert row["fallback"] == "M3:too-few-points"


@pytest.mark.parametrize("start", ["=", "+", "-", "@", "\t", "\r"])
def test_formulas_are_defused(start: str) -> None:
    assert defused(f"{start}cmd") == f"'{start}cmd"


def test_plain_text_stays() -> None:
    assert defused("row-3 = left") == "row-3 = left"
    assert defused("") == ""
