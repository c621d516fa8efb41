from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("streamlit")


from tests.greenhouse.pages.app_pages import WALK, app, classes, keys, listed, said, tap

from cucumbervision_greenhouse.rounds.fruit_table import fruit_table, read_round
from cucumbervision_greenhouse.store.records import Verdict
from cucumbervision_greenhouse.store.repository import open_store


def walked(house: Path) -> list[str]:
    """The keys of the fruit, in the order of the rows."""
    with open_store(house) as store:
        return [fruit.key for fruit in fruit_table(read_round(store, WALK))]


pytestmark = pytest.mark.usefixtures("fresh_caches")


def test_results_count_the_round_and_show_its_fruit(house: Path) -> None:
    test = app("results")
    shown = {metric.label: metric.value for metric in test.metric}
    assert shown["Fruit"] == shown["Measured"] == "8"
    # Mean of the eight bundled fruit as drawn: 21.1 cm.
    assert float(shown["Mean length"].split()[0]) == pytest.approx(21.1, abs=0.6)
    assert len(listed(test)) == 8
    assert classes(test) == {"class I", "class II", "too short", "undecided"}


def test_filters_leave_fruit_out(house: Path) -> None:
    test = app("results", filters=True)
    chosen = next(box for box in test.selectbox if box.label == "Class")
    chosen.select("class I").run()
    assert classes(test) == {"class I"}


def test_closed_filters_and_files_are_not_drawn_and_still_count(house: Path) -> None:
    test = app("results", only_Class="class I")
    assert {box.label for box in test.selectbox} & {"Row", "Class", "Checked", "With"} == set()
    assert not [x for x in test.get("html") if "/api/files/" in x.proto.body]
    assert classes(test) == {"class I"}
    test.session_state["only_Class"] = "class of another round"
    assert len(listed(test.run())) == 8


def test_filters_and_order_stay_while_a_fruit_is_open(house: Path) -> None:
    test = app("results", filters=True)
    next(box for box in test.selectbox if box.label == "Class").select("too short").run()
    next(box for box in test.selectbox if box.label == "Order").select("Shortest first").run()
    lengths_cm = [float(says[0].split()[0]) for says in listed(test)]
    assert len(lengths_cm) == 3
    assert lengths_cm == sorted(lengths_cm)
    [shortest, second, _] = keys(test)
    test.query_params["fruit"] = shortest
    test.run()
    tap(test, "Next")
    assert test.query_params["fruit"] == second
    tap(test, "All fruit")
    assert [float(says[0].split()[0]) for says in listed(test)] == lengths_cm


def test_fruit_with_something_to_look_at_are_listed_alone(house: Path) -> None:
    with open_store(house) as store:
        judged = [view.key for view in store.detections(WALK)][:2]
        store.set_verdict(judged, Verdict.ACCEPTED)
    test = app("results", filters=True)
    next(x for x in test.selectbox if x.label == "With").select("one view, not checked").run()
    assert len(listed(test)) == 6  # of eight fruit, each seen once
    assert not set(judged) & set(keys(test))


def test_the_next_unsure_fruit_is_the_least_certain_that_nobody_checked(house: Path) -> None:
    with open_store(house) as store:
        views = [view for view in store.detections(WALK) if view.views == 1]
    by_score = [view.key for view in sorted(views, key=lambda view: (view.score, view.key))]
    test = app("results", fruit=by_score[1])
    tap(test, "Next unsure")
    assert test.query_params["fruit"] == by_score[2]
    with open_store(house) as store:
        store.set_verdict(by_score[1:], Verdict.ACCEPTED)
    test.run()
    tap(test, "Next unsure")
    assert test.query_params["fruit"] == by_score[0]
    assert next(b for b in test.button if b.label == "Next unsure").disabled


def test_a_fruit_is_accepted_picked_and_both_are_undone(house: Path) -> None:
    with open_store(house) as store:
        key = store.detections(WALK)[0].key
    test = app("results", fruit=key)
    assert not test.exception
    assert re.fullmatch(r"Likely between [\d.]+ and [\d.]+ cm", test.metric[0].delta)

    def press(label: str) -> None:
        next(button for button in test.button if button.label == label).click().run()

    def view() -> Any:
        with open_store(house) as store:
            return store.detection(key).view

    press("Accept")
    assert view().verdict is Verdict.ACCEPTED
    assert test.query_params["fruit"] != key  # reviewing goes on to the next fruit
    press("Previous")
    press("Picked")
    assert view().picked_s is not None
    press("Undo")
    assert view().picked_s is None
    press("Undo")
    assert view().verdict is None
    press("Undo")
    assert "Nothing to undo" in said(test)


def test_the_other_finds_of_a_picture_are_accepted_at_once(house: Path) -> None:
    with open_store(house) as store:
        first, *_ = views = store.detections(WALK)
    test = app("results", fruit=first.key)
    label = "Accept the rest of this picture"
    next(button for button in test.button if button.label == label).click().run()
    assert not test.exception
    with open_store(house) as store:
        judged = {one.key for one in store.detections(WALK) if one.verdict is Verdict.ACCEPTED}
        store.undo(WALK)
    here = (first.stop_key, first.capture)
    assert judged == {one.key for one in views if (one.stop_key, one.capture) == here}


def test_previous_and_next_walk_through_the_fruit(house: Path) -> None:
    keys = walked(house)
    test = app("results", fruit=keys[0])
    assert next(b for b in test.button if b.label == "Previous").disabled
    next(b for b in test.button if b.label == "Next").click().run()
    assert test.query_params["fruit"] == keys[1]
    next(b for b in test.button if b.label == "All fruit").click().run()
    assert any(metric.label == "Mean length" for metric in test.metric)


def test_a_fruit_marked_as_none_keeps_its_place_among_the_others(house: Path) -> None:
    keys = walked(house)
    test = app("results", fruit=keys[1])
    tap(test, "Not a fruit")
    assert test.query_params["fruit"] == keys[2]
    test.query_params["fruit"] = keys[1]
    test.run()
    for label, key in (("Next", keys[2]), ("Previous", keys[0])):
        tap(test, label)
        assert test.query_params["fruit"] == key
        test.query_params["fruit"] = keys[1]
        test.run()
