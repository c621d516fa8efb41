from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("streamlit")


from tests.greenhouse.pages.app_pages import WALK, app, field, said, tap, wait_for_jobs

from cucumbervision_greenhouse.store.records import Verdict
from cucumbervision_greenhouse.store.repository import open_store

pytestmark = pytest.mark.usefixtures("fresh_caches")


def test_a_stop_is_moved_deleted_and_both_are_undone(house: Path) -> None:
    def places() -> list[tuple[str | None, float | None]]:
        with open_store(house) as store:
            return [(stop.row, stop.position_m) for stop in store.stops(WALK)]

    before = places()
    with open_store(house) as store:
        first = store.stops(WALK)[0]
    test = app("row_map", round=WALK, stops=True, **{f"stop_of_{WALK}": first.key})
    next(box for box in test.text_input if box.label == "Row").set_value("12").run()
    next(box for box in test.number_input if box.label == "At [m]").set_value(7.5).run()
    tap(test, "Save")
    moved = places()
    assert moved == [("12", 7.5), *before[1:]]
    tap(test.run(), "Delete this stop")
    assert places() == before[1:]
    for left in (moved, before):
        next(b for b in test.run().button if b.label == "Undo").click().run()
        wait_for_jobs()
        assert places() == left


def test_a_stop_that_the_address_names_is_opened(house: Path) -> None:
    with open_store(house) as store:
        stop = store.stops(WALK)[1]
    test = app("row_map", round=WALK, stop=stop.key)
    assert field(test, "number_input", "At [m]").value == stop.position_m
    closed = app("row_map", round=WALK)
    assert "Stop" not in {box.label for box in closed.selectbox}  # hundreds of names


def test_what_was_typed_just_before_the_tap_is_saved(house: Path) -> None:
    with open_store(house) as store:
        first = store.stops(WALK)[0]
    test = app("row_map", round=WALK, stops=True, **{f"stop_of_{WALK}": first.key})
    # No run between: the page was drawn before anything was typed.
    field(test, "text_input", "Row").set_value("12")
    field(test, "text_input", "Name").set_value("long leaf")
    tap(test, "Save")
    field(test, "text_input", "Name of this round").set_value("Evening")
    tap(test, "Rename")
    with open_store(house) as store:
        now = store.stops(WALK)[0]
        assert store.rounds()[0].name == "Evening"
    assert (now.row, now.note, now.position_m) == ("12", "long leaf", first.position_m)


def test_what_another_viewer_saved_meanwhile_is_not_overwritten(house: Path) -> None:
    with open_store(house) as store:
        stop = store.stops(WALK)[0]
    state: dict[str, Any] = {"stops": True, f"stop_of_{WALK}": stop.key}
    first, second = (app("row_map", round=WALK, **state) for _ in range(2))
    field(first, "number_input", "At [m]").set_value(7.5)
    field(second, "text_input", "Name").set_value("long leaf")
    tap(first, "Save")
    tap(second, "Save")
    assert "changed it meanwhile" in said(second)
    assert field(second, "number_input", "At [m]").value == 7.5
    field(second, "text_input", "Name").set_value("long leaf")
    tap(second, "Save")
    with open_store(house) as store:
        now = next(x for x in store.stops(WALK) if x.key == stop.key)
    assert (now.position_m, now.note) == (7.5, "long leaf")


def test_what_is_typed_stays_while_somebody_else_judges_fruit(house: Path) -> None:
    with open_store(house) as store:
        first, fruit = store.stops(WALK)[0], store.detections(WALK)[0].key
        test = app("row_map", round=WALK, stops=True, **{f"stop_of_{WALK}": first.key})
        field(test, "text_input", "Name").set_value("long leaf")
        store.set_verdict([fruit], Verdict.ACCEPTED)
        store.pick([fruit])
        test.run()
    assert field(test, "text_input", "Name").value == "long leaf"


def test_after_undo_the_fields_say_what_the_stop_says(house: Path) -> None:
    with open_store(house) as store:
        first = store.stops(WALK)[0]
        test = app("row_map", round=WALK, stops=True, **{f"stop_of_{WALK}": first.key})
        field(test, "text_input", "Name").set_value("long leaf")
        tap(test, "Save")
        # Somebody else changes it too: undone after that, and not forgotten.
        later = store.place_stop(
            replace(first, row="1", side="left", position_m=-0.5, step=-1, note="short leaf")
        )
        test.run()
        assert not test.exception
        assert field(test, "number_input", "At [m]").value == -0.5
        next(b for b in test.button if b.label == "Undo").click().run()
        assert "undo the later change first" in said(test)
        store.undo(number=later)
        next(b for b in test.button if b.label == "Undo").click().run()
        wait_for_jobs()
        assert field(test, "text_input", "Name").value == first.note
        tap(test, "Save")
        now = store.stops(WALK)[0]
    assert (now.note, now.position_m) == (first.note, first.position_m)


def test_a_third_side_of_a_row_is_put_right_where_it_is_seen(house: Path) -> None:
    with open_store(house) as store:
        stops = store.stops(WALK)
        keys = [stop.key for stop in stops]
        for at, (stop, side) in enumerate(zip(stops, ("A", "B", "left"), strict=True)):
            store.place_stop(replace(stop, row="1", side=side, position_m=float(at), step=at))
    test = app("row_map", round=WALK, stops=True, **{f"stop_of_{WALK}": keys[2]})
    assert len(test.exception) == 1  # whether its words are shown is Streamlit's setting
    side = field(test, "selectbox", "Side")
    assert (side.options, side.value) == (["A", "B", "left"], "left")
    side.select("B")
    tap(test, "Save")
    assert not test.run().exception
