from __future__ import annotations

import sqlite3
from math import hypot
from typing import TYPE_CHECKING

import pytest
from sqlalchemy import func, select, text

from cucumbervision.errors import StoreError
from cucumbervision_greenhouse.store.engine import begin
from cucumbervision_greenhouse.store.records import Round, Verdict, key_of, new_key
from cucumbervision_greenhouse.store.repository import Store, open_store
from cucumbervision_greenhouse.store.schema import METADATA

if TYPE_CHECKING:
    from pathlib import Path

    from tests.greenhouse.store.conftest import MakeStop


WALK = key_of("walk")


def test_rounds_are_listed_with_what_they_hold(store: Store, make_stop: MakeStop) -> None:
    store.save_round(Round(key_of("other"), "elsewhere", "house 2", 500.0))
    store.save_stop(make_stop(1))
    store.save_stop(make_stop(2, fruit=3))
    found = [(r.name, r.stops, r.fruit, r.last_s) for r in store.rounds()]
    assert found == [
        ("next morning", 0, 0, None),
        ("morning", 2, 5, 1002.0),
        ("elsewhere", 0, 0, None),
    ]


def test_a_fruit_lies_where_its_stop_and_its_offset_say(store: Store, make_stop: MakeStop) -> None:
    store.save_stop(make_stop(2))
    _, second = store.detections(WALK)
    assert second.along_m == pytest.approx(0.8 + 0.2)
    assert second.along_sd_m == pytest.approx(hypot(0.04, 0.03))
    store.save_stop(make_stop(3, position_m=None))
    assert store.detections(WALK)[2].along_m is None


def test_a_list_leaves_out_what_is_heavy_and_one_fruit_has_it(
    store: Store, make_stop: MakeStop
) -> None:
    stop = make_stop(1)
    store.save_stop(stop)
    listed = store.detections(WALK)[1]
    whole = stop.captures[0].fruit[1]
    assert listed.cells == whole.cells
    assert (listed.mask, listed.keypoints, listed.path_m) == (None, (), ())
    detail = store.detection(listed.key)
    assert detail.view == listed.with_(**whole.shape)
    assert store.detections(WALK, shapes=True)[1] == detail.view
    assert (detail.capture, detail.stop) == (stop.captures[0], stop)
    assert detail.log == ()


def test_what_is_not_there_is_said(store: Store) -> None:
    for call in ("stops", "detections", "links", "stop", "detection", "undo"):
        with pytest.raises(StoreError, match="is not in the store"):
            getattr(store, call)(new_key())


def test_an_open_reader_neither_waits_for_a_writer_nor_sees_half(
    store: Store, make_stop: MakeStop
) -> None:
    store.save_stop(make_stop(1))
    with begin(store.engine, write=True) as connection:
        connection.execute(text("UPDATE stops SET note = 'changed'"))
        assert [stop.note for stop in store.stops(WALK)] == [""]
    assert [stop.note for stop in store.stops(WALK)] == ["changed"]


def test_a_reader_sees_one_moment(store: Store, make_stop: MakeStop) -> None:
    count = select(func.count()).select_from(METADATA.tables["stops"])
    with begin(store.engine) as connection:
        before = connection.execute(count).scalar_one()
        store.save_stop(make_stop(1))
        assert connection.execute(count).scalar_one() == before == 0


def test_the_times_of_picking_are_by_fruit(store: Store, make_stop: MakeStop) -> None:
    store.save_stop(make_stop(1))
    first, second = (view.key for view in store.detections(WALK))
    store.pick([first], at_s=1500.0)
    store.pick([second], at_s=1600.0)
    store.unpick([first])
    assert store.picked(WALK) == {second: 1600.0}
    assert store.picked(key_of("next day")) == {}


def test_the_newest_action_of_a_round_leaves_out_what_does_not_matter(
    store: Store, make_stop: MakeStop
) -> None:
    store.save_stop(make_stop(1))
    key = store.detections(WALK)[0].key
    assert store.newest_action(WALK) == 0
    first = store.set_verdict([key], Verdict.ACCEPTED)
    second = store.pick([key], at_s=1500.0)
    assert first < second == store.newest_action(WALK)
    assert store.newest_action(WALK, without=["pick"]) == first
    assert store.newest_action(WALK, without=["pick", "accept"]) == 0
    assert store.newest_action(key_of("next day")) == 0


def test_who_undoes_sees_what_they_did_themselves(store: Store, make_stop: MakeStop) -> None:
    store.save_stop(make_stop(1))
    key = store.detections(WALK)[0].key
    ana = store.signed("ana")
    by_nobody = store.set_verdict([key], Verdict.ACCEPTED)
    by_ana = ana.pick([key], at_s=1500.0)
    assert [line.number for line in store.own_actions(WALK)] == [by_nobody]
    assert [line.number for line in ana.own_actions(WALK)] == [by_ana]
    assert [line.number for line in store.signed("ana", "tablet").own_actions(WALK)] == [by_nobody]
    # Who did nothing yet may undo what a command did.
    assert [line.number for line in store.signed("bo").own_actions(WALK)] == [by_nobody]
    ana.undo(number=by_ana)
    assert [line.number for line in ana.own_actions(WALK)] == [by_nobody]
    assert store.own_actions(key_of("next day")) == []


def test_cameras_and_what_they_were_measured_with_are_by_stop(
    store: Store, make_stop: MakeStop
) -> None:
    pose = tuple(float(x) for x in range(16))
    first, second = make_stop(1, pose=pose), make_stop(2, artifacts=())
    next_day = Round(key_of("next day"), "next morning", "house 1", 87400.0)
    for stop in (first, second, make_stop(1, round=next_day)):
        store.save_stop(stop)
    stops = store.stops(WALK)
    assert [stop.key for stop in stops] == [first.key, second.key]
    assert [stop.pose for stop in stops] == [pose, ()]
    assert stops[0].camera == {"fx_px": 600.0}
    assert [capture.name for capture in stops[0].captures] == ["a"]
    assert [stop.artifacts for stop in stops] == [first.artifacts, ()]


def test_a_round_that_cannot_be_read_is_not_taken_for_a_missing_one(tmp_path: Path) -> None:
    with open_store(tmp_path / "house.db") as store:
        assert store.round("no key") is None
        assert store.round(new_key()) is None
        with sqlite3.connect(tmp_path / "house.db") as database:
            database.execute("ALTER TABLE rounds RENAME TO elsewhere")
        database.close()
        with pytest.raises(StoreError, match="no such table"):
            store.round(new_key())
