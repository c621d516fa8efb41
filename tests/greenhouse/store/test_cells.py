from __future__ import annotations

import math
from dataclasses import replace

import pytest

from cucumbervision.errors import StoreError
from cucumbervision.measurement.result import IntervalBasis, Length, LengthDefinition
from cucumbervision_greenhouse.store.cells import detection_from_json, pack_um, points, unpack_um
from cucumbervision_greenhouse.store.records import (
    DetectionRecord,
    key_of,
    record_json,
)
from cucumbervision_greenhouse.store.repository import Store

from .conftest import WALK, MakeStop

STOP, JOINT = key_of(WALK.key, 0), key_of("joint")


def test_a_fruit_comes_back_from_json() -> None:
    fruit = DetectionRecord(3, keypoints=((1.5, 2.5, 0.25),), mask="123", flags="end-hidden")
    assert detection_from_json(record_json(fruit)) == fruit


def test_a_captures_gravity_and_a_raw_lengths_interval_come_back(
    store: Store, make_stop: MakeStop
) -> None:
    centreline, own = LengthDefinition.CENTRELINE, IntervalBasis.OWN_TRUTH
    raw = Length(0.25, centreline, 0.24, 0.27, centreline, IntervalBasis.SIMULATED)
    fruit = DetectionRecord(1, length=Length(0.26, centreline, 0.25, 0.27, centreline, own))
    stop = make_stop()
    [capture] = stop.captures
    turned = replace(capture, gravity=(0.0, 0.6, 0.8), fruit=(replace(fruit, raw_length=raw),))
    store.save_stop(replace(stop, captures=(turned,)))
    [read] = store.stop(stop.key).captures
    assert read == turned


def test_paths_keep_whole_micrometres() -> None:
    packed = pack_um([(0.123456, -1.0, 1999.0)])
    assert len(packed) == 12
    assert points(packed) == ((0.123456, -1.0, 1999.0),)
    assert unpack_um(b"") == ()


@pytest.mark.parametrize("value", [math.nan, math.inf, 3000.0])
def test_a_path_of_no_positions_is_refused(value: float) -> None:
    with pytest.raises(StoreError, match="not a position"):
        pack_um([value])
