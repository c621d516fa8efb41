from __future__ import annotations

import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from math import hypot
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from sqlalchemy import func, select, text

from cucumbervision.errors import NameRefusedError, StoreConflictError, StoreError
from cucumbervision_greenhouse.store.engine import begin
from cucumbervision_greenhouse.store.records import (
    CaptureRecord,
    DetectionRecord,
    MethodRecord,
    Round,
    Saved,
    StopRecord,
    key_of,
    new_key,
)
from cucumbervision_greenhouse.store.repository import Store, open_store
from cucumbervision_greenhouse.store.schema import Base
from cucumbervision_greenhouse.store.views import DetectionFilter, Verdict

if TYPE_CHECKING:
    from tests.greenhouse.store.conftest import MakeStop

WALK = key_of("walk")


def lines(store: Store) -> dict[str, int]:
    """Count every table's lines."""
    with begin(store.engine) as connection:
        return {
            name: connection.execute(select(func.count()).select_from(table)).scalar_one()
            for name, table in Base.metadata.tables.items()
        }


def test_a_stop_comes_back_as_it_was_sent(store: Store, make_stop: MakeStop) -> None:
    stop = make_stop(3, pose=tuple(float(x) for x in range(16)), note="=1+1 'quoted' ž\n")
    assert store.save_stop(stop) is Saved.NEW
    assert store.stop(stop.key) == stop


@pytest.mark.parametrize("bad", ["a\0", "a\ud800b", "a\u202eb", "a\nb", "a\x1b["])
def test_a_name_that_is_none_is_refused_by_every_database_alike(
    store: Store, make_stop: MakeStop, bad: str
) -> None:
    stop, before = make_stop(3), lines(store)
    capture = replace(stop.captures[0], name=bad)
    for changed in ({"row": bad}, {"side": bad}, {"note": bad}, {"captures": (capture,)}):
        with pytest.raises(NameRefusedError):
            store.save_stop(replace(stop, **changed))
    for named in (Round(name=bad), Round(house=bad)):
        with pytest.raises(NameRefusedError):
            store.save_round(named)
    with pytest.raises(NameRefusedError):
        store.rename_round(WALK, bad)
    assert lines(store) == before


def test_a_house_gets_the_name_that_it_had_first(store: Store) -> None:
    first = Round(house=" House 7 ")
    second = Round(house="7")
    assert store.save_round(first) is store.save_round(second) is Saved.NEW
    houses = {one.key: one.record.house for one in store.rounds()}
    assert houses[first.key] == houses[second.key] == "House 7"
    assert store.save_round(second) is Saved.ALREADY_THERE


def test_a_stop_with_nothing_in_it_comes_back_too(store: Store) -> None:
    stop = StopRecord(new_key(), WALK)
    store.save_stop(stop)
    assert store.stop(stop.key) == stop
    [view] = store.stops(WALK)
    assert (view.row, view.captures, view.fruit, view.thumbnail) == (None, 0, 0, None)


def test_the_same_stop_sent_again_changes_nothing_and_says_so(
    store: Store, make_stop: MakeStop
) -> None:
    store.save_stop(make_stop(1))
    before = lines(store)
    assert before["fruit"] == 2
    assert before["measurements"] == 4
    assert store.save_stop(make_stop(1)) is Saved.ALREADY_THERE
    # However its key is written.
    again = replace(make_stop(1), key=make_stop(1).key.upper())
    assert store.save_stop(again) is Saved.ALREADY_THERE
    assert lines(store) == before


def test_another_stop_under_the_same_key_is_refused_and_the_first_stays(
    store: Store, make_stop: MakeStop
) -> None:
    store.save_stop(make_stop(1))
    with pytest.raises(StoreConflictError, match="already stored with another content; give"):
        store.save_stop(replace(make_stop(1), position_m=0.41))
    assert store.stop(make_stop(1).key) == make_stop(1)


def test_a_stop_that_fails_half_way_leaves_nothing(store: Store, make_stop: MakeStop) -> None:
    before = lines(store)
    endless = MethodRecord("M5", path_m=((5000.0, 0.0, 0.0),))
    fruit = (DetectionRecord(1), DetectionRecord(2, methods=(endless,)))
    captures = (make_stop().captures[0], CaptureRecord("b", fruit=fruit))
    with pytest.raises(StoreError, match="not a position"):
        store.save_stop(make_stop(1, captures=captures, row="99"))
    assert lines(store) == before
    assert store.save_stop(make_stop(1)) is Saved.NEW


def test_a_stop_needs_its_round(store: Store, make_stop: MakeStop) -> None:
    with pytest.raises(StoreError, match="is not in the store; save the round first"):
        store.save_stop(make_stop(1, round_key=new_key()))


@pytest.mark.parametrize(
    ("captures", "fault"),
    [
        ((CaptureRecord("a"), CaptureRecord("a")), "two captures are called a"),
        (
            (CaptureRecord("a", fruit=(DetectionRecord(1), DetectionRecord(1))),),
            "two fruit have number 1",
        ),
    ],
)
def test_doubles_within_a_stop_are_refused(
    store: Store, make_stop: MakeStop, captures: tuple[CaptureRecord, ...], fault: str
) -> None:
    with pytest.raises(StoreError, match=fault):
        store.save_stop(make_stop(1, captures=captures))


def test_rounds_are_listed_with_what_they_hold(store: Store, make_stop: MakeStop) -> None:
    store.save_round(Round(key_of("other"), "elsewhere", "house 2", 500.0))
    store.save_stop(make_stop(1))
    store.save_stop(make_stop(2, fruit=3))
    found = [(r.record.name, r.stops, r.fruit, r.last_s) for r in store.rounds()]
    assert found == [
        ("next morning", 0, 0, None),
        ("morning", 2, 5, 1002.0),
        ("elsewhere", 0, 0, None),
    ]


def test_a_round_sent_again_changes_nothing_and_another_is_refused(store: Store) -> None:
    walk = store.rounds()[1].record
    assert store.save_round(walk) is Saved.ALREADY_THERE
    with pytest.raises(StoreConflictError, match=r"round .* another content"):
        store.save_round(replace(walk, name="evening"))


def test_rows_of_a_house_are_kept_once(store: Store, make_stop: MakeStop) -> None:
    for step in (1, 2):
        store.save_stop(make_stop(step))
    store.save_stop(make_stop(3, row="4"))
    assert lines(store)["rows"] == 2
    assert lines(store)["artifacts"] == 1
    assert [stop.row for stop in store.stops(WALK)] == ["3", "3", "4"]


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
    assert listed.record == replace(whole, mask=None, keypoints=(), methods=())
    detail = store.detection(listed.key)
    assert detail.view == replace(listed, record=whole)
    assert detail.original == whole
    assert (detail.capture, detail.stop) == (stop.captures[0], stop)
    assert (detail.links, detail.log) == ((), ())
    methods = tuple(replace(one, path_m=(), diameter_m=()) for one in whole.methods)
    assert store.measurements(WALK)[listed.key] == methods


def test_filters_keep_what_they_say(store: Store, make_stop: MakeStop) -> None:
    store.save_stop(make_stop(1))
    store.save_stop(make_stop(2, row="4"))
    unmeasured = CaptureRecord("a", fruit=(DetectionRecord(1),))
    store.save_stop(make_stop(3, side="right", captures=(unmeasured,)))
    keys = [one.key for one in store.detections(WALK)]
    store.set_verdict([keys[2]], Verdict.REJECTED)

    def kept(**only: Any) -> list[int]:
        found = store.detections(WALK, DetectionFilter(**only))
        return [10 * (one.step or 0) + one.record.number for one in found]

    assert kept() == [11, 12, 21, 22, 31]
    assert kept(row="4") == [21, 22]
    assert kept(stop_key=key_of(WALK, 1)) == [11, 12]
    assert kept(min_length_m=0.115) == [12, 21, 22]
    assert kept(verdict=Verdict.REJECTED) == [21]
    assert kept(min_length_m=0.215, row="4") == [22]


def test_what_is_not_there_is_said(store: Store) -> None:
    for call in (
        "stops",
        "detections",
        "links",
        "measurements",
        "stop",
        "detection",
        "undo",
    ):
        with pytest.raises(StoreError, match="is not in the store"):
            getattr(store, call)(new_key())


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


def test_pictures_of_a_file_lie_beside_it(tmp_path: Path) -> None:
    with open_store(tmp_path / "house.db") as store:
        assert store.images.folder == tmp_path / "house.images"


def test_an_open_reader_neither_waits_for_a_writer_nor_sees_half(
    store: Store, make_stop: MakeStop
) -> None:
    store.save_stop(make_stop(1))
    with begin(store.engine, write=True) as connection:
        connection.execute(text("UPDATE stops SET note = 'changed'"))
        assert [stop.note for stop in store.stops(WALK)] == [""]
    assert [stop.note for stop in store.stops(WALK)] == ["changed"]


def test_a_reader_sees_one_moment(store: Store, make_stop: MakeStop) -> None:
    count = select(func.count()).select_from(Base.metadata.tables["stops"])
    with begin(store.engine) as connection:
        before = connection.execute(count).scalar_one()
        store.save_stop(make_stop(1))
        assert connection.execute(count).scalar_one() == before == 0


def test_many_threads_lose_nothing(store: Store, make_stop: MakeStop) -> None:
    # Every stop is sent by two threads at once.
    stops = [make_stop(step // 2) for step in range(40)]
    with ThreadPoolExecutor(8) as pool:
        said = list(pool.map(store.save_stop, stops))
    assert said.count(Saved.NEW) == said.count(Saved.ALREADY_THERE) == 20
    assert len(store.detections(WALK)) == 40


WRITER = """
import sys
from cucumbervision_greenhouse.store.records import StopRecord, key_of
from cucumbervision_greenhouse.store.repository import open_store

address, name = sys.argv[1:]
with open_store(address) as store:
    for n in range(15):
        store.save_stop(StopRecord(key_of(name, n), key_of("walk"), row=str(n)))
"""


def test_two_programs_and_a_page_write_to_one_store(store: Store, make_stop: MakeStop) -> None:
    address = store.engine.url.render_as_string(hide_password=False)
    store.save_stop(make_stop(1))
    fruit = store.detections(WALK)[0].key
    writers = [
        subprocess.Popen([sys.executable, "-c", WRITER, address, name], stderr=subprocess.PIPE)
        for name in ("dashboard", "command")
    ]
    marks = 0
    while any(writer.poll() is None for writer in writers):
        store.set_verdict([fruit], Verdict.ACCEPTED)
        marks += 1
        threading.Event().wait(0.01)
    assert [writer.communicate()[1] for writer in writers] == [b"", b""]
    assert len(store.stops(WALK)) == 31
    assert lines(store)["rows"] == 15
    assert len(store.log(limit=None)) == marks


def test_what_a_server_acknowledged_outlives_its_crash(cluster: Any, make_stop: MakeStop) -> None:
    with open_store(cluster.new_database()) as store:
        store.save_round(Round(WALK))
        for step in range(5):
            store.save_stop(make_stop(step))
        cluster.stop(at_once=True)
        with pytest.raises(StoreError, match="PostgreSQL server runs"):
            store.save_stop(make_stop(5))
        cluster.start()
        # The same open store goes on.
        assert store.save_stop(make_stop(4)) is Saved.ALREADY_THERE
        assert store.save_stop(make_stop(5)) is Saved.NEW
        assert len(store.detections(WALK)) == 12
