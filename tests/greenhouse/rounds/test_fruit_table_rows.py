from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from tests.greenhouse.rounds.conftest import MORNING

from cucumbervision.errors import RoundError, StoreError
from cucumbervision.methods.result import Length, LengthDefinition, LengthKind
from cucumbervision_greenhouse.rounds.fruit_table import (
    StoredRow,
    counted_fruit,
    find_round,
    read_round,
    stored_merging,
)
from cucumbervision_greenhouse.store import records
from cucumbervision_greenhouse.store.repository import Store

CENTRELINE = LengthDefinition.CENTRELINE
# Half of 640 pixels over a focal length of 400, and half of 480 over 400.
CAMERA = {"width": 640, "height": 480, "fx": 400.0, "fy": 400.0}


def fruit(number: int, length_m: float | None = 0.2, **changes: Any) -> records.FruitRow:
    """A fruit 10 cm to the right of the camera for each number, 5 cm below it, 60 cm away."""
    length = None
    if length_m is not None:
        length = Length(length_m, CENTRELINE, 0.95 * length_m, 1.05 * length_m, CENTRELINE)
    record = records.FruitRow(
        number,
        method="M6",
        length=length,
        centre_x_m=0.1 * number,
        centre_y_m=0.05,
        centre_z_m=0.6,
        diameter_max_m=0.04,
        view_score=0.5,
    )
    return record.with_(**changes)


def stop_at(step: int, *detections: records.FruitRow, **changes: Any) -> records.StopRecord:
    record = records.StopRecord(
        key=records.key_of(MORNING.key, step),
        round_key=MORNING.key,
        row="3",
        side="left",
        position_m=0.5 * step,
        position_sd_m=0.02,
        step=step,
        taken_s=MORNING.started_s + step,
        captures=(records.CaptureRecord("a", camera=CAMERA, fruit=detections),),
    )
    return replace(record, **changes)


def rows(store: Store, *stops: records.StopRecord) -> dict[str, StoredRow]:
    for one in stops:
        store.save_stop(one)
    return {row.name: row for row in read_round(store, MORNING.key).rows}


def test_rounds_are_found_by_name(store: Store) -> None:
    assert find_round(store).key == find_round(store, "morning").key == MORNING.key
    assert find_round(store, MORNING.key[:6]).key == MORNING.key
    with pytest.raises(RoundError, match="no round is called 'evening'"):
        find_round(store, "evening")


def test_a_number_is_never_the_start_of_a_rounds_key(store: Store) -> None:
    key = "2aaaaaaa-0000-4000-8000-000000000000"
    store.save_round(records.Round(key, "Tuesday"))
    assert find_round(store, "2aa").key == key
    with pytest.raises(RoundError, match="no round is called '2'"):
        find_round(store, "2")


def test_two_rounds_of_one_name_are_told_apart_by_key(store: Store) -> None:
    store.save_round(
        records.Round(records.key_of("again"), "morning", started_s=MORNING.started_s + 60)
    )
    with pytest.raises(RoundError, match="several rounds are called 'morning'"):
        find_round(store, "morning")
    assert find_round(store, records.key_of("again").upper()).key == find_round(store).key
    assert find_round(store).key == records.key_of("again")


def test_a_round_that_is_nowhere_is_named(store: Store) -> None:
    with pytest.raises(StoreError, match="is not in the store; see `round list`"):
        read_round(store, records.new_key())


def test_a_row_has_its_stops_and_views_as_arrays(store: Store) -> None:
    row = rows(store, stop_at(1, fruit(1), fruit(2, 0.3)), stop_at(2, fruit(1)))["3"]
    np.testing.assert_allclose(row.stops.at_m, [[0.5, 0, 0], [1.0, 0, 0]])
    np.testing.assert_allclose(row.stops.sd_m, [[0.02, 0.03, 0.03]] * 2)
    np.testing.assert_allclose(row.stops.reach, [0.8] * 2)
    assert row.views.stop.tolist() == [0, 0, 1]
    np.testing.assert_allclose(
        row.views.offset_m, [[0.1, -0.05, 0.6], [0.2, -0.05, 0.6], [0.1, -0.05, 0.6]]
    )
    np.testing.assert_allclose(row.views.length_m, [0.2, 0.3, 0.2])
    # 1.645 standard deviations are 5 %, to the logarithm's first order.
    np.testing.assert_allclose(row.views.length_sd, 0.05 / 1.645, rtol=0.01)
    assert len(set(row.views.capture.tolist())) == 2
    assert (row.sides, row.unplaced) == (("left",), 0)


def test_the_other_aisle_looks_back_at_the_row(store: Store) -> None:
    other_side = stop_at(2, fruit(1), side="right")
    row = rows(store, stop_at(1, fruit(1)), other_side)["3"]
    assert (row.sides, row.stops.side.tolist()) == (("left", "right"), [0, 1])
    np.testing.assert_allclose(row.views.offset_m, [[0.1, -0.05, 0.6], [-0.1, -0.05, -0.6]])


def test_what_cannot_be_placed_is_counted_apart(store: Store) -> None:
    no_middle = fruit(2, centre_x_m=None, centre_y_m=None, centre_z_m=None)
    nowhere = stop_at(2, fruit(1), position_m=None)
    row = rows(store, stop_at(1, fruit(1), no_middle), nowhere)["3"]
    assert (len(row.stops), row.views.stop.tolist(), row.unplaced) == (1, [0], 2)
    unknown = rows(store, stop_at(3, row=None, position_m=None))[""]
    assert (len(unknown.stops), len(unknown.views.stop), unknown.unplaced) == (0, 0, 0)


def test_lengths_without_interval_or_of_another_kind_count_for_little(store: Store) -> None:
    exact = Length(0.2, CENTRELINE, 0.1999, 0.2001, CENTRELINE)
    arc = Length(0.2, LengthKind.SURFACE_ARC, 0.199, 0.201, CENTRELINE)
    record = stop_at(
        1,
        fruit(1, None),
        fruit(2, length=Length(0.2, CENTRELINE)),
        fruit(3, length=exact),
        fruit(4, length=arc),
    )
    views = rows(store, record)["3"].views
    assert np.isnan(views.length_m).tolist() == [True, False, False, False]
    assert views.length_sd.tolist() == [0.08, 0.08, 0.01, 0.08]


def test_a_camera_that_is_not_stored_is_a_d435(store: Store) -> None:
    bare = stop_at(1, captures=(records.CaptureRecord("a"),))
    flat = stop_at(2, captures=(records.CaptureRecord("a", camera={**CAMERA, "fx": 0.0}),))
    # A D435's colour camera sees 69 degrees.
    half = np.tan(np.deg2rad(69.0) / 2)
    np.testing.assert_allclose(rows(store, bare, flat)["3"].stops.reach, [half] * 2, atol=2e-3)


def test_what_people_say_of_fruit_is_in_the_row(store: Store) -> None:
    rows(store, stop_at(1, fruit(1), fruit(2), fruit(3)))
    keys = [view.key for view in store.detections(MORNING.key)]
    store.set_verdict(keys[:1], records.Verdict.ACCEPTED)
    store.set_verdict(keys[1:2], records.Verdict.REJECTED)
    content = read_round(store, MORNING.key)
    (row,) = content.rows
    assert [view.key for view in row.fruit] == [keys[0], keys[2]]
    assert [view.key for view in counted_fruit(content.views)] == [keys[0], keys[2]]


def test_three_sides_of_one_row_are_refused(store: Store) -> None:
    with pytest.raises(RoundError, match="row '3' has 3 sides: back, left, right"):
        rows(store, stop_at(1), stop_at(2, side="right"), stop_at(3, side="back"))


def test_a_merged_row_comes_back_as_it_was_saved(store: Store) -> None:
    row = rows(store, stop_at(1, fruit(1), fruit(2)), stop_at(2, fruit(1)))["3"]
    _, second, third = (view.key for view in row.fruit)
    place = {records.key_of(MORNING.key, 2): (0.97, 0.005)}
    store.save_merging(
        MORNING.key, [records.LinkRecord(records.LinkKind.SAME, second, third, 0.9)], place
    )
    content = read_round(store, MORNING.key)
    cluster, stops = stored_merging(content.rows[0])
    assert cluster[1] == cluster[2] != cluster[0]
    np.testing.assert_allclose(stops.at_m[:, 0], [0.5, 0.97])
