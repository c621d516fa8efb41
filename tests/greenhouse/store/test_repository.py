from __future__ import annotations

import sqlite3
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import permutations
from math import hypot
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import func, select, text
from tests.greenhouse.store.conftest import MakeStop

from cucumbervision.errors import NameRefusedError, StoreError
from cucumbervision_greenhouse.store import records
from cucumbervision_greenhouse.store.engine import begin
from cucumbervision_greenhouse.store.records import LinkKind, LinkRecord
from cucumbervision_greenhouse.store.repository import Store, group_detections, open_store
from cucumbervision_greenhouse.store.schema import METADATA

WALK = records.key_of("walk")


def lines(store: Store) -> dict[str, int]:
    """Count every table's lines."""
    with begin(store.engine) as connection:
        return {
            name: connection.execute(select(func.count()).select_from(table)).scalar_one()
            for name, table in METADATA.tables.items()
        }


@pytest.mark.parametrize("bad", ["a\0", "a\ud800b", "a\u202eb", "a\nb", "a\x1b["])
def test_a_name_that_is_none_is_refused_by_every_database_alike(
    store: Store, make_stop: MakeStop, bad: str
) -> None:
    stop, before = make_stop(3), lines(store)
    capture = replace(stop.captures[0], name=bad)
    for changed in ({"row": bad}, {"side": bad}, {"note": bad}, {"captures": (capture,)}):
        with pytest.raises(NameRefusedError):
            store.save_stop(replace(stop, **changed))
    for named in (records.Round(name=bad), records.Round(house=bad)):
        with pytest.raises(NameRefusedError):
            store.save_round(named)
    with pytest.raises(NameRefusedError):
        store.rename_round(WALK, bad)
    assert lines(store) == before


def test_long_names_of_places_are_refused_and_those_of_files_are_kept(
    store: Store, make_stop: MakeStop
) -> None:
    stop, long = make_stop(3), "x" * 201
    for changed in (replace(stop, row=long), replace(stop, side=long), replace(stop, note=long)):
        with pytest.raises(NameRefusedError, match="201 characters"):
            store.save_stop(changed)
    capture = replace(stop.captures[0], name=long)
    assert store.save_stop(replace(stop, captures=(capture,)))
    assert store.stop(stop.key).captures[0].name == long


def test_a_house_gets_the_name_that_it_had_first(store: Store) -> None:
    first = records.Round(house=" House 7 ")
    second = records.Round(house="7")
    assert store.save_round(first) is store.save_round(second) is True
    houses = {one.key: one.house for one in store.rounds()}
    assert houses[first.key] == houses[second.key] == "House 7"
    assert not store.save_round(second)


def test_a_stop_that_fails_half_way_leaves_nothing(store: Store, make_stop: MakeStop) -> None:
    before = lines(store)
    fruit = (records.FruitRow(1), records.FruitRow(2, path_m=((float("inf"), 0.0, 0.0),)))
    captures = (make_stop().captures[0], records.CaptureRecord("b", fruit=fruit))
    with pytest.raises(StoreError, match="cannot be stored"):
        store.save_stop(make_stop(1, captures=captures, row="99"))
    assert lines(store) == before
    assert store.save_stop(make_stop(1))


def test_a_stop_needs_its_round(store: Store, make_stop: MakeStop) -> None:
    with pytest.raises(StoreError, match="is not in the store; save the round first"):
        store.save_stop(make_stop(1, round_key=records.new_key()))


def test_pictures_of_a_server_need_a_folder(cluster: Any) -> None:
    with (
        open_store(cluster.new_database()) as store,
        pytest.raises(
            StoreError, match=r"open the store with images=FOLDER, or postgresql://…\?images=FOLDER"
        ),
    ):
        _ = store.images


def test_the_address_of_a_server_names_the_folder_of_the_pictures(
    cluster: Any, tmp_path: Path
) -> None:
    address = cluster.new_database()
    mark = "&" if "?" in address else "?"
    with open_store(f"{address}{mark}images={tmp_path}/of%20the%20house") as store:
        assert store.images.folder == tmp_path / "of the house"
        assert "images" not in store.name


def test_the_address_of_a_file_may_name_the_folder_of_the_pictures(tmp_path: Path) -> None:
    address = f"sqlite:///{tmp_path}/house.db?images={tmp_path}/pictures"
    with open_store(address) as store:
        assert store.images.folder == tmp_path / "pictures"
    with pytest.raises(StoreError, match="names 2 folders of pictures"):
        open_store(f"{address}&images={tmp_path}/others")


def test_many_threads_lose_nothing(store: Store, make_stop: MakeStop) -> None:
    # Every stop is sent by two threads at once.
    stops = [make_stop(step // 2) for step in range(40)]
    with ThreadPoolExecutor(8) as pool:
        said = list(pool.map(store.save_stop, stops))
    assert sum(said) == 20
    assert len(store.detections(WALK)) == 40


def test_what_a_server_acknowledged_outlives_its_crash(cluster: Any, make_stop: MakeStop) -> None:
    with open_store(cluster.new_database()) as store:
        store.save_round(records.Round(WALK))
        for step in range(5):
            store.save_stop(make_stop(step))
        cluster.stop(at_once=True)
        with pytest.raises(StoreError, match="PostgreSQL server runs"):
            store.save_stop(make_stop(5))
        cluster.start()
        # The same open store goes on.
        assert not store.save_stop(make_stop(4))
        assert store.save_stop(make_stop(5))
        assert len(store.detections(WALK)) == 12


def test_texts_of_a_stop_that_no_database_takes_are_made_readable(
    store: Store, make_stop: MakeStop
) -> None:
    stop = make_stop(3)
    # So Python reads a file's name that is no UTF-8.
    source = b"caf\xe9".decode(errors="surrogateescape")
    damaged = replace(
        stop,
        captures=(replace(stop.captures[0], source=source, provenance={"file": [source, 1]}),),
        artifacts=(records.ArtifactRecord("model", source, "ab", {source: "a\0"}),),
        failures=({"capture": source},),
    )
    assert store.save_stop(damaged)
    assert not store.save_stop(damaged)
    saved = store.stop(stop.key)
    assert (saved.captures[0].source, saved.captures[0].provenance) == (
        "caf?",
        {"file": ["caf?", 1]},
    )
    assert saved.artifacts == (records.ArtifactRecord("model", "caf?", "ab", {"caf?": "a?"}),)
    assert saved.failures == ({"capture": "caf?"},)


def test_a_number_of_a_stop_is_taken_by_every_database_alike(
    store: Store, make_stop: MakeStop
) -> None:
    stop = make_stop(3)
    store.save_stop(stop)
    place = replace(stop, position_m=1.0, step=2**31 - 1)
    store.place_stop(place)
    for step in (2**31, -(2**63), 2**64):
        with pytest.raises(StoreError, match="has no number"):
            store.place_stop(replace(place, step=step))
        with pytest.raises(StoreError, match="has no number"):
            store.save_stop(replace(stop, key=records.new_key(), step=step))
    with pytest.raises(StoreError):
        store.undo(number=2**64)


def same_pair(pair: str, score: float | None = None, *, by_hand: bool = False) -> LinkRecord:
    return LinkRecord(LinkKind.SAME, pair[0], pair[1], score, by_hand)


def apart(pair: str) -> LinkRecord:
    return LinkRecord(LinkKind.APART, pair[0], pair[1], by_hand=True)


def shape(keys: str, links: list[LinkRecord]) -> set[str]:
    return {"".join(sorted(group)) for group in group_detections(keys, links)}


def test_links_join_whatever_their_order() -> None:
    links = [same_pair("ab"), same_pair("dc"), same_pair("bc")]
    for order in permutations(links):
        assert shape("abcde", list(order)) == {"abcd", "e"}


def test_the_surest_link_wins_where_two_must_not_meet() -> None:
    links = [same_pair("ab", 0.6), same_pair("bc", 0.7), apart("ac")]
    for order in permutations(links):
        assert shape("abc", list(order)) == {"a", "bc"}


def test_a_link_by_hand_goes_before_the_surest() -> None:
    assert shape("abc", [same_pair("ab", by_hand=True), same_pair("bc", 1.0), apart("ca")]) == {
        "ab",
        "c",
    }


def test_two_that_must_not_meet_do_not_meet_through_others() -> None:
    links = [same_pair("ab", 0.9), same_pair("cd", 0.8), same_pair("bc", 0.7), apart("ad")]
    assert shape("abcd", links) == {"ab", "cd"}


def test_growth_and_other_rounds_fruit_join_nothing() -> None:
    growth = LinkRecord(LinkKind.GROWTH, "a", "b")
    assert shape("ab", [growth, same_pair("az"), same_pair("zb")]) == {"a", "b"}


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


NEXT_DAY = records.key_of("next day")


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
