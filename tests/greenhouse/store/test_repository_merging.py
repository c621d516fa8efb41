"""Joint measurements go into every database and come out again."""

from __future__ import annotations

import pytest

from cucumbervision.errors import StoreError
from cucumbervision.measurement.result import Length
from cucumbervision_greenhouse.store.records import (
    DetectionRecord,
    JointRecord,
    MethodRecord,
    Round,
    key_of,
)
from cucumbervision_greenhouse.store.repository import open_store

WALK = Round(key_of("walk"), "morning")
TUBE = MethodRecord(
    "M6", 0.21, "centreline", path_m=((0.0, 0.1, 0.5), (0.0, 0.31, 0.5)), diameter_m=(0.04, 0.04)
)
POSE = (1.0, 0.0, 0.0, -0.3, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0)
WHOLE = JointRecord(
    key_of("a"),
    "first",
    2,
    record=DetectionRecord(1, length=Length(0.21), methods=(TUBE,)),
    poses={"second": POSE},
)
NOTHING = JointRecord(key_of("b"), "third", 0, "not-measured")


def test_they_are_read_as_they_were_saved(address: str) -> None:
    with open_store(address) as store:
        store.save_round(WALK)
        store.save_joint(WALK.key, [WHOLE, NOTHING], ())
    with open_store(address) as store:
        found = store.joint(WALK.key)
        assert set(found) == {WHOLE.key, NOTHING.key}
        # Lists leave out the path and the poses.
        assert found[WHOLE.key].record == DetectionRecord(1, length=Length(0.21))
        assert found[NOTHING.key] == NOTHING
        assert store.joint_drawing(WALK.key, WHOLE.key) == WHOLE
        assert store.joint_drawing(WALK.key, NOTHING.key) == NOTHING
        with pytest.raises(StoreError, match="is not there; merge again"):
            store.joint_drawing(WALK.key, key_of("c"))
        assert store.joint(key_of("another round")) == {}


def test_only_what_is_still_of_use_stays(address: str) -> None:
    newer = JointRecord(key_of("d"), "first", 0, "end-hidden")
    with open_store(address) as store:
        store.save_round(WALK)
        store.save_joint(WALK.key, [WHOLE, NOTHING], ())
        store.save_joint(WALK.key, [newer, WHOLE], [WHOLE.key])
        assert set(store.joint(WALK.key)) == {WHOLE.key, newer.key}
        store.save_joint(WALK.key, [], [])
        assert store.joint(WALK.key) == {}
