from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cucumbervision.capture.frames import Capture, Stop
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.fruit.instance import Instance, MaskSource
from cucumbervision.methods.result import LengthDefinition
from cucumbervision.methods.selector import measure_fruit
from cucumbervision.run.fields import (
    ALL_FIELDS,
    FIELDS,
    Cell,
    fruit_row,
    stored_length,
    stored_row,
    table_row,
)

field = {one.name: one for one in FIELDS}.__getitem__

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
    names = [c.name for c in FIELDS]
    assert ", ".join(names[:20]) == NAMED_BY_THE_ISSUE
    assert len(set(names)) == len(names)
    assert all(c.unit == "cm" for c in FIELDS if c.name.endswith("_cm"))
    assert {c.type for c in FIELDS} == {"text", "whole", "number", "yes/no"}


def test_a_measured_fruit_fills_its_row(capture: Capture, instance: Instance) -> None:
    row = fruit_row(capture, 2, measure_fruit(capture, instance))
    assert list(row) == [c.name for c in FIELDS]
    assert (row["capture"], row["frame"], row["fruit"], row["score"]) == ("plate", 17, 2, 0.91)
    assert row["method"] == "M6"
    assert row["reason"] == "mask-points-ge-100"
    assert row["length_kind"] == "centreline"
    assert row["m5_cm"] == pytest.approx(20, rel=0.04)
    assert row["m6_cm"] == row["centreline_cm"] == pytest.approx(20, rel=0.05)
    assert row["length_cm"] == row["centreline_cm"] == pytest.approx(20, rel=0.05)
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


@pytest.mark.parametrize("definition", LengthDefinition)
def test_a_tube_gives_the_length_that_was_asked(
    capture: Capture, instance: Instance, definition: LengthDefinition
) -> None:
    fruit = measure_fruit(capture, instance, definition=definition)
    row = fruit_row(capture, 1, fruit)
    assert fruit.traits is not None
    by_hand = 100 * getattr(fruit.traits.lengths, f"{definition}_m")
    assert row["length_cm"] == row[f"{definition}_cm"] == pytest.approx(by_hand, abs=5e-4)
    assert (row["length_kind"], row["interval_of"]) == (definition, definition)


def test_cells_are_the_result_in_the_columns_units(capture: Capture, instance: Instance) -> None:
    fruit = measure_fruit(capture, instance)
    traits, length, pose = fruit.traits, fruit.length, fruit.pose
    assert traits is not None
    assert pose is not None
    assert pose.cut_m is not None
    assert pose.cut_covariance_m2 is not None
    assert length is not None
    assert length.low_m is not None
    row, stored = fruit_row(capture, 1, fruit), stored_row(capture, 1, fruit)
    by_hand: dict[str, Cell] = {
        "interval_low_cm": round(100 * length.low_m, 3),
        "interval_basis": "simulated",
        "inner_arc_mm": round(1000 * traits.inner_arc_m, 2),
        "inner_arc_mm_per_10cm": round(100 * traits.inner_arc_m / traits.lengths.chord_m, 2),
        "diameter_max_mm": round(1000 * traits.diameter_max_m, 2),
        "volume_ml": round(1e6 * traits.volume_m3, 1),
        "box_x2_px": 839.5,
        "mask_source": "sam",
        "simulated": False,
        "raw_length_cm": None,
        "cut_y_m": round(pose.cut_m[1], 4),
        "cut_xz_mm2": round(1e6 * pose.cut_covariance_m2[0, 2], 2),
        "cut_zz_mm2": round(1e6 * pose.cut_covariance_m2[2, 2], 2),
    }
    assert {name: row[name] for name in by_hand} == by_hand
    assert stored["volume_m3"] == round(traits.volume_m3, 9)
    assert stored["length_m"] == round(length.value_m, 9)
    assert stored["cut_zz_m2"] == round(pose.cut_covariance_m2[2, 2], 9)
    # Enumerations are plain texts in tables and in the store.
    assert type(row["mask_source"]) is type(stored["reason"]) is str


def test_the_store_names_fields_by_their_si_units() -> None:
    names = [
        field(n).si_name
        for n in ("length_cm", "volume_ml", "inner_arc_mm", "tilt_deg", "cut_xz_mm2")
    ]
    assert names == ["length_m", "volume_m3", "inner_arc_m", "tilt_deg", "cut_xz_m2"]
    assert field("inner_arc_mm_per_10cm").si_name == "inner_arc_mm_per_10cm"


def test_the_method_named_is_the_one_that_measured(capture: Capture, instance: Instance) -> None:
    few = np.zeros_like(instance.mask)
    few[360, 440:480] = True
    row = fruit_row(capture, 1, measure_fruit(capture, replace(instance, mask=few)))
    assert row["method"] == "M2"
    assert row["reason"] == "mask-points-lt-100"
    assert row["fallback"] == "M3:too-few-points"


def test_a_row_of_a_store_is_a_row_of_the_tables_again(
    capture: Capture, instance: Instance
) -> None:
    fruit = measure_fruit(capture, instance)
    stored = stored_row(capture, 1, fruit, ALL_FIELDS)
    assert table_row(stored) == pytest.approx(fruit_row(capture, 1, fruit), abs=0.02)
    assert fruit.length is not None
    again = stored_length(stored)
    assert again is not None
    assert (again.kind, again.interval_of, again.basis) == ("centreline", "centreline", "simulated")
    assert again.low_m == pytest.approx(fruit.length.low_m, abs=1e-9)
    assert stored_length(stored, "raw_") is None
