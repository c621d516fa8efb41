from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from cucumbervision.measurement.result import Length
from cucumbervision_greenhouse.rounds.from_store import read_round
from cucumbervision_greenhouse.rounds.fruit_table import around, least_sure_first
from cucumbervision_greenhouse.rounds.merge_and_link import DAY_S, row_counts
from cucumbervision_greenhouse.rounds.row_fruit import FalseShare
from cucumbervision_greenhouse.store.records import (
    CaptureRecord,
    DetectionRecord,
    Round,
    StopRecord,
    key_of,
)
from cucumbervision_greenhouse.store.repository import Store, open_store
from cucumbervision_greenhouse.store.views import Verdict

MONDAY = Round(key_of("monday"), "monday", "north", 1_700_000_000.0)
TUESDAY = replace(MONDAY, key=key_of("tuesday"), name="tuesday", started_s=1_700_000_000.0 + DAY_S)


def stop(round_key: str, number: int, offsets: tuple[float, ...]) -> StopRecord:
    fruit = tuple(
        DetectionRecord(
            n,
            score=0.3 + 0.1 * n,
            length=Length(0.2),
            centre_x_m=x,
            centre_y_m=0.0,
            centre_z_m=0.7,
            offset_m=x,
            view_score=0.5,
        )
        for n, x in enumerate(offsets, 1)
    )
    return StopRecord(
        key_of(round_key, number),
        round_key,
        "3",
        "right",
        0.4 * number,
        step=number,
        taken_s=float(number),
        captures=(CaptureRecord("a", fruit=fruit),),
    )


@pytest.fixture
def store(tmp_path: Path) -> Store:
    opened = open_store(tmp_path / "house.db")
    for one in (MONDAY, TUESDAY):
        opened.save_round(one)
        opened.save_stop(stop(one.key, 0, (0.0, 0.3)))
        opened.save_stop(stop(one.key, 1, (-0.1, 0.9)))
    return opened


def test_views_neighbours_and_days_stand_about_a_fruit(store: Store) -> None:
    # Along the row: 0.0 and 0.3 m of the first stop, 0.3 and 1.3 m of the second.
    first, second, again, far = store.detections(TUESDAY.key)
    store.merge(second.key, again.key)
    found = around(store, TUESDAY.key, again.key)
    assert found is not None
    assert {view.key for view in found.views} == {second.key, again.key}
    assert found.views[0].best
    assert [view.key for view in found.neighbours] == [first.key]  # the other is a metre away
    assert far.key not in {view.key for view in found.neighbours}
    assert found.later is None
    assert found.earlier is not None
    assert found.earlier.linked is None
    monday = store.detections(MONDAY.key)
    assert [view.key for view in found.earlier.neighbours][:2] == [
        monday[1].key,
        monday[2].key,
    ] or [view.key for view in found.earlier.neighbours][:2] == [monday[2].key, monday[1].key]
    number = store.link_growth(monday[1].key, second.key)
    linked = around(store, TUESDAY.key, second.key)
    assert linked is not None
    assert linked.earlier is not None
    assert linked.earlier.linked is not None
    assert linked.earlier.linked.key == monday[1].key
    store.undo(number=number)
    back = around(store, TUESDAY.key, second.key)
    assert back is not None
    assert back.earlier is not None
    assert back.earlier.linked is None


def test_the_least_sure_are_looked_at_first_until_somebody_judged_them(store: Store) -> None:
    views = store.detections(MONDAY.key)
    assert [round(v.record.score, 1) for v in least_sure_first(views)] == [0.4, 0.4, 0.5, 0.5]
    store.set_verdict([views[0].key], Verdict.ACCEPTED)
    assert len(least_sure_first(store.detections(MONDAY.key))) == 3


def test_what_people_say_of_a_house_is_what_is_believed_of_its_next_round(store: Store) -> None:
    views = store.detections(MONDAY.key)
    assert read_round(store, TUESDAY.key).false == FalseShare()
    store.set_verdict([views[0].key], Verdict.REJECTED)
    store.set_verdict([views[1].key], Verdict.ACCEPTED)
    content = read_round(store, TUESDAY.key)
    assert content.false == FalseShare.learnt(1, 4)
    assert content.false.share > FalseShare().share
    (row,) = row_counts(read_round(store, MONDAY.key))
    assert len(row.count.view_counts) == 3  # without the rejected one
    assert row.count.real.max() == 1.0  # the accepted one is a fruit
    low, high = row.count.interval()
    assert low <= row.count.expected <= high
