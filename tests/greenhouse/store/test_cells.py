from __future__ import annotations

import math
import sqlite3
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest

from cucumbervision.errors import StoreError
from cucumbervision.measurement.result import IntervalBasis, Length, LengthDefinition
from cucumbervision_greenhouse.store import queries
from cucumbervision_greenhouse.store.cells import detection_from_json, pack_um, points, unpack_um
from cucumbervision_greenhouse.store.check import changed_lines
from cucumbervision_greenhouse.store.records import (
    DetectionRecord,
    JointRecord,
    key_of,
    record_json,
)
from cucumbervision_greenhouse.store.repository import Store, open_store
from cucumbervision_greenhouse.store.views import Verdict

from .conftest import WALK, MakeStop

STOP, JOINT = key_of(WALK.key, 0), key_of("joint")


def _joint(store: Store) -> object:
    return store.joint(WALK.key)


def _drawing(store: Store) -> object:
    return store.joint_drawing(WALK.key, JOINT)


@pytest.mark.parametrize(
    ("change", "read"),
    [
        ("stops SET position_sd_m = 'wide'", lambda store: store.detections(WALK.key)),
        ("stops SET failures = '{}'", lambda store: store.stops(WALK.key)),
        ("stops SET pose = '[1'", lambda store: store.cameras(WALK.key)),
        ("stops SET pose = '[\"x\"]', mirrored = 1", lambda store: store.cameras(WALK.key)),
        ("masks SET keypoints = '[1]'", lambda store: store.stop(STOP)),
        ("measurements SET path_um = x'0102'", lambda store: store.stop(STOP)),
        ("marks SET value = 'perhaps'", lambda store: store.detections(WALK.key)),
        ("joint_measurements SET record = '" + "[" * 20_000 + "'", _joint),
        (
            'joint_measurements SET record = \'{"number": 1, "length": {"value_m": "long"}}\'',
            _joint,
        ),
        ("joint_measurements SET drawing = '{\"poses\": 3}'", _drawing),
    ],
)
def test_a_cell_that_no_record_is_made_of_is_damage(
    tmp_path: Path, make_stop: MakeStop, change: str, read: Callable[[Store], object]
) -> None:
    with open_store(tmp_path / "house.db") as store:
        store.save_round(WALK)
        store.save_stop(make_stop())
        store.save_joint(WALK.key, [JointRecord(JOINT, "a", 2, record=DetectionRecord(1))], ())
        store.set_verdict([store.detections(WALK.key)[0].key], Verdict.ACCEPTED)
        read(store)
        with closing(sqlite3.connect(tmp_path / "house.db")) as raw:
            raw.execute(f"UPDATE {change}")
            raw.commit()
        with pytest.raises(StoreError, match=r"house.db: .*; copy the database away"):
            read(store)


def test_a_defect_of_ours_is_not_called_damage(
    store: Store, make_stop: MakeStop, monkeypatch: pytest.MonkeyPatch
) -> None:
    store.save_stop(make_stop())
    monkeypatch.setattr(queries, "StopSummary", lambda: None)
    with pytest.raises(TypeError, match="positional arguments"):
        store.stops(WALK.key)


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
    assert changed_lines(store) == []


def test_paths_keep_whole_micrometres() -> None:
    packed = pack_um([(0.123456, -1.0, 1999.0)])
    assert len(packed) == 12
    assert points(packed) == ((0.123456, -1.0, 1999.0),)
    assert unpack_um(b"") == ()


@pytest.mark.parametrize("value", [math.nan, math.inf, 3000.0])
def test_a_path_of_no_positions_is_refused(value: float) -> None:
    with pytest.raises(StoreError, match="not a position"):
        pack_um([value])
