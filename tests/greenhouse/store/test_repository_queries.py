from __future__ import annotations

import sqlite3
from dataclasses import replace
from math import hypot
from pathlib import Path

import pytest
from sqlalchemy import text
from tests.greenhouse.store.conftest import MakeStop

from cucumbervision.errors import StoreError
from cucumbervision_greenhouse.store import records
from cucumbervision_greenhouse.store.engine import begin
from cucumbervision_greenhouse.store.repository import Store, open_store

WALK = records.key_of("walk")


def test_rounds_are_listed_with_what_they_hold(store: Store, make_stop: MakeStop) -> None:
    store.save_round(records.Round(records.key_of("other"), "elsewhere", "house 2", 500.0))
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
    without = replace(stop.captures[0], fruit=())
    assert detail.stop == replace(stop, captures=(without,), fruit=2)
    assert detail.capture == without
    assert detail.log == ()


def test_what_is_not_there_is_said(store: Store) -> None:
    for call in ("stops", "detections", "links", "stop", "detection", "undo"):
        with pytest.raises(StoreError, match="is not in the store"):
            getattr(store, call)(records.new_key())


def test_an_open_reader_neither_waits_for_a_writer_nor_sees_half(
    store: Store, make_stop: MakeStop
) -> None:
    store.save_stop(make_stop(1))
    with begin(store.engine, write=True) as connection:
        connection.execute(text("UPDATE stops SET note = 'changed'"))
        assert [stop.note for stop in store.stops(WALK)] == [""]
    assert [stop.note for stop in store.stops(WALK)] == ["changed"]


def test_the_times_of_picking_are_by_fruit(store: Store, make_stop: MakeStop) -> None:
    store.save_stop(make_stop(1))
    first, second = (view.key for view in store.detections(WALK))
    store.pick([first], at_s=1500.0)
    store.pick([second], at_s=1600.0)
    store.unpick([first])
    assert store.picked(WALK) == {second: 1600.0}
    assert store.picked(records.key_of("next day")) == {}


def test_the_newest_action_of_a_round_leaves_out_what_does_not_matter(
    store: Store, make_stop: MakeStop
) -> None:
    store.save_stop(make_stop(1))
    key = store.detections(WALK)[0].key
    assert store.newest_action(WALK) == 0
    first = store.set_verdict([key], records.Verdict.ACCEPTED)
    second = store.pick([key], at_s=1500.0)
    assert first < second == store.newest_action(WALK)
    assert store.newest_action(WALK, without=["pick"]) == first
    assert store.newest_action(WALK, without=["pick", "accept"]) == 0
    assert store.newest_action(records.key_of("next day")) == 0


def test_who_undoes_sees_what_they_did_themselves(store: Store, make_stop: MakeStop) -> None:
    store.save_stop(make_stop(1))
    key = store.detections(WALK)[0].key
    ana = store.signed("ana")
    by_nobody = store.set_verdict([key], records.Verdict.ACCEPTED)
    by_ana = ana.pick([key], at_s=1500.0)
    assert [line.number for line in store.own_actions(WALK)] == [by_nobody]
    assert [line.number for line in ana.own_actions(WALK)] == [by_ana]
    assert [line.number for line in store.signed("ana", "tablet").own_actions(WALK)] == [by_nobody]
    # Who did nothing yet may undo what a command did.
    assert [line.number for line in store.signed("bo").own_actions(WALK)] == [by_nobody]
    ana.undo(number=by_ana)
    assert [line.number for line in ana.own_actions(WALK)] == [by_nobody]
    assert store.own_actions(records.key_of("next day")) == []


def test_cameras_and_what_they_were_measured_with_are_by_stop(
    store: Store, make_stop: MakeStop
) -> None:
    pose = tuple(float(x) for x in range(16))
    first, second = make_stop(1, pose=pose), make_stop(2, artifacts=())
    next_day = records.Round(records.key_of("next day"), "next morning", "house 1", 87400.0)
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
        assert store.round(records.new_key()) is None
        with sqlite3.connect(tmp_path / "house.db") as database:
            database.execute("ALTER TABLE rounds RENAME TO elsewhere")
        database.close()
        with pytest.raises(StoreError, match="no such table"):
            store.round(records.new_key())


def test_a_stop_comes_back_as_it_was_sent(store: Store, make_stop: MakeStop) -> None:
    pose, note = tuple(float(x) for x in range(16)), "=1+1 'quoted' ž\n"
    stop = make_stop(3, fruit=0, pose=pose, note=note)
    assert store.save_stop(stop)
    assert store.stop(stop.key) == stop


def test_a_stop_with_nothing_in_it_comes_back_too(store: Store) -> None:
    stop = records.StopRecord(key=records.new_key(), round_key=WALK)
    store.save_stop(stop)
    assert store.stop(stop.key) == stop
    [view] = store.stops(WALK)
    assert (view.row, view.captures, view.fruit, view.thumbnail) == (None, (), 0, None)


WALK, NEXT_DAY = records.key_of("walk"), records.key_of("next day")


@pytest.fixture
def views(store: Store, make_stop: MakeStop) -> list[str]:
    """Two fruit at each of two stops, and the next day again."""
    for walk in (records.Round(WALK, started_s=1000.0), records.Round(NEXT_DAY, started_s=87400.0)):
        for step in (1, 2):
            store.save_stop(make_stop(step, round=walk))
    return [detection.key for walk in (WALK, NEXT_DAY) for detection in store.detections(walk)]


def same(first: str, second: str, score: float | None = None) -> records.LinkRecord:
    return records.LinkRecord(records.LinkKind.SAME, first, second, score)


def test_each_run_replaces_what_the_last_one_said(store: Store, views: list[str]) -> None:
    stop = records.key_of(WALK, 2)
    store.save_merging(WALK, [same(views[0], views[2], 0.7)], {stop: (0.77, 0.01)})
    assert store.links(WALK) == [same(views[0], views[2], 0.7)]
    view = store.stops(WALK)[1]
    assert (view.position_m, view.fitted_m, view.fitted_sd_m) == (0.8, 0.77, 0.01)
    fruit = store.detections(WALK)[2]
    assert fruit.along_m == pytest.approx(0.77 + 0.1)
    assert fruit.along_sd_m == pytest.approx(hypot(0.01, 0.03))
    store.save_merging(WALK, [same(views[1], views[2])])
    assert store.links(WALK) == [same(views[1], views[2])]
    assert store.stops(WALK)[1].fitted_m is None
    # What was sent is as it was.
    assert store.stop(stop).position_m == 0.8


def test_growth_between_two_rounds(store: Store, views: list[str]) -> None:
    growth = [
        records.LinkRecord(records.LinkKind.GROWTH, views[k], views[k + 4], 0.9) for k in (0, 1)
    ]
    store.save_merging(WALK, [same(views[0], views[2])])
    store.save_growth(WALK, NEXT_DAY, growth)
    assert store.links(NEXT_DAY) == growth
    assert store.links(WALK, records.LinkKind.SAME) == [same(views[0], views[2])]
    store.save_growth(WALK, NEXT_DAY, growth[:1])
    assert store.links(NEXT_DAY) == growth[:1]
    # A new merging leaves growth alone.
    store.save_merging(WALK, [])
    assert store.links(WALK) == growth[:1]
