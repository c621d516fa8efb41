from __future__ import annotations

import json
import re
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("streamlit")

from streamlit.testing.v1 import AppTest

from cucumbervision.calibration.calibration_file import read_site_calibration
from cucumbervision.capture.frames import Stop
from cucumbervision.capture.readers import open_source
from cucumbervision.capture.realsense_device import CameraSettings
from cucumbervision.capture.source import example_captures
from cucumbervision.measurement.result import LengthDefinition
from cucumbervision_greenhouse.backend import resources, round_caches
from cucumbervision_greenhouse.backend.hand_lengths import hand_file, write_hand_lengths
from cucumbervision_greenhouse.capture_page.state import walk
from cucumbervision_greenhouse.rounds.demonstration import DEMONSTRATION, round_for_capture
from cucumbervision_greenhouse.rounds.merge_and_link import link_rounds, move_stop, settle
from cucumbervision_greenhouse.store.corrections import StopPlace
from cucumbervision_greenhouse.store.records import Round, StopRecord, key_of, new_key
from cucumbervision_greenhouse.store.repository import Store, open_store
from cucumbervision_greenhouse.store.views import Verdict

WALK, LONG = key_of("walk"), key_of("long walk")
PAGES = ("today", "upload", "results", "row_map", "days", "forecast", "accuracy", "settings")


pytestmark = pytest.mark.usefixtures("fresh_caches")


def app(page: str, **state: Any) -> AppTest:
    script = (
        "from cucumbervision_greenhouse.dashboard.app import keep_inputs\n"
        f"from cucumbervision_greenhouse.dashboard.views import {page}\n"
        f"keep_inputs()\n{page}.page()\n"
    )
    test = AppTest.from_string(script, default_timeout=600)
    for name, value in state.items():
        if name in ("fruit", "stop", "row"):  # the address names them
            test.query_params[name] = value
        else:
            test.session_state[name] = value
    return test.run()


def said(test: AppTest) -> str:
    parts = [*test.info, *test.warning, *test.error, *test.success, *test.markdown, *test.caption]
    return "\n".join(str(part.value) for part in parts).replace("\\", "")  # as it is drawn


def listed(test: AppTest) -> list[list[str]]:
    """What the list of fruit says of each."""
    [drawn] = [x for x in test.get("bidi_component") if "fruitlist" in x.proto.component_name]
    return [one["says"] for one in json.loads(drawn.proto.json)["fruit"]]


def classes(test: AppTest) -> set[str]:
    return {re.split(r" \(|: ", says[1])[0] for says in listed(test)}


def wait_for_jobs() -> None:
    for job in resources.worker().unfinished():
        assert job.wait(600)


@pytest.mark.parametrize("page", PAGES)
def test_every_page_opens_on_an_empty_store(
    page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CUCUMBERVISION_STORE", str(tmp_path / "new" / "house.db"))
    test = app(page)
    assert not test.exception
    if page != "settings":
        assert "round" in said(test).lower()


@pytest.mark.parametrize("page", PAGES)
def test_every_page_opens_on_a_round(page: str, house: Path) -> None:
    assert not app(page).exception


def test_results_count_the_round_and_show_its_fruit(house: Path) -> None:
    test = app("results")
    shown = {metric.label: metric.value for metric in test.metric}
    assert shown["Fruit"] == shown["Measured"] == "8"
    # Mean of the eight bundled fruit as drawn: 21.1 cm.
    assert float(shown["Mean length"].split()[0]) == pytest.approx(21.1, abs=0.6)
    assert len(listed(test)) == 8
    assert classes(test) == {"class I", "class II", "too short", "undecided"}


def test_filters_leave_fruit_out(house: Path) -> None:
    test = app("results")
    chosen = next(box for box in test.selectbox if box.label == "Class")
    chosen.select("class I").run()
    assert classes(test) == {"class I"}


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
    press("Picked")
    assert view().picked_s is not None
    press("Undo")
    assert view().picked_s is None
    press("Undo")
    assert view().verdict is None
    press("Undo")
    assert "Nothing to undo" in said(test)


@pytest.mark.parametrize("page", ["results", "row_map"])
def test_undo_leaves_what_another_viewer_did_since(page: str, house: Path) -> None:
    with open_store(house) as store:
        mine, other = (one.key for one in store.detections(WALK)[:2])
        tap(app("results", fruit=mine), "Not a fruit")
        store.signed("dashboard", "another browser").set_verdict([other], Verdict.REJECTED)
        test = app(page, fruit=mine)
        tap(test, "Undo")
        rejected = [x.key for x in store.detections(WALK) if x.verdict is Verdict.REJECTED]
        assert rejected == [other]
        assert test.toast[0].value.replace("\\", "") == "Taken back: not a fruit"
        tap(test, "Undo")
        assert "Nothing to undo" in said(test)
        assert [x.key for x in store.detections(WALK) if x.verdict is Verdict.REJECTED] == [other]


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
    with open_store(house) as store:
        keys = [view.key for view in store.detections(WALK)]
    test = app("results", fruit=keys[0])
    assert next(b for b in test.button if b.label == "Previous").disabled
    next(b for b in test.button if b.label == "Next").click().run()
    assert test.query_params["fruit"] == keys[1]
    next(b for b in test.button if b.label == "All fruit").click().run()
    assert any(metric.label == "Mean length" for metric in test.metric)


def test_a_fruit_marked_as_none_keeps_its_place_among_the_others(house: Path) -> None:
    with open_store(house) as store:
        keys = [view.key for view in store.detections(WALK) if view.best]
    test = app("results", fruit=keys[1])
    tap(test, "Not a fruit")
    for label, key in (("Next", keys[2]), ("Previous", keys[0])):
        tap(test, label)
        assert test.query_params["fruit"] == key
        test.query_params["fruit"] = keys[1]
        test.run()


@pytest.mark.parametrize("page", [page for page in PAGES if page != "settings"])
def test_an_address_of_no_round_shows_no_other_one(page: str, house: Path) -> None:
    test = app(page, round="nonsense")
    assert "There is no round 'nonsense'" in said(test)
    assert not [*test.metric, *test.button_group, *test.get("bidi_component")]
    test.run()  # drawn anew, as by news
    assert "There is no round 'nonsense'" in said(test)
    test.selectbox(key="round").select(WALK).run()
    assert "nonsense" not in said(test)


@pytest.mark.parametrize(
    ("page", "part", "words"),
    [
        ("results", "fruit", "no such fruit"),
        ("row_map", "fruit", "no such fruit"),
        ("row_map", "stop", "no such stop"),
    ],
)
def test_an_address_of_no_fruit_or_stop_is_told(
    page: str, part: str, words: str, house: Path
) -> None:
    assert words in said(app(page, **{part: "![x](http://a)"}))


def test_another_row_of_an_upload_begins_at_its_own_place_and_outlives_a_reload(
    store: Store, house: Path
) -> None:
    for step, row, at_m in ((11, "7", 3.0), (12, "7", 3.5), (13, "1", 8.0), (14, "1", 8.4)):
        store.save_stop(StopRecord(key_of(step), WALK, row, "left", at_m, step=step, taken_s=2e9))
    test = app("upload")

    def place() -> list[Any]:
        fields = (
            ("text_input", "Row"),
            ("number_input", "First at [m]"),
            ("number_input", "Step [m]"),
        )
        return [field(test, *one).value for one in fields]

    assert place() == ["1", 8.8, 0.4]
    field(test, "text_input", "Row").set_value("7").run()
    assert place() == ["7", 4.0, 0.5]
    field(test, "text_input", "Row").set_value("new").run()
    assert place() == ["new", 0.0, 0.4]
    field(test, "number_input", "First at [m]").set_value(2.5).run()
    # Another capture is measured meanwhile: what was typed stays.
    store.save_stop(StopRecord(key_of(15), WALK, "1", "left", 8.8, step=15, taken_s=2e9))
    test.run()
    assert place() == ["new", 2.5, 0.4]
    again = app("upload", row=test.query_params["row"])
    assert field(again, "text_input", "Row").value == "new"


def test_the_row_map_tells_two_fruit_from_one_and_takes_that_back(house: Path) -> None:
    with open_store(house) as store:
        first, second, *_ = store.detections(WALK)
    test = app("row_map", round=WALK, fruit=first.key)
    assert not test.exception
    assert "real (" in said(test)

    def groups() -> int:
        with open_store(house) as store:
            return sum(view.best for view in store.detections(WALK))

    def press(label: str) -> None:  # at the second fruit, of whichever is open
        buttons = [one for one in test.button if one.label == label]
        next(one for one in buttons if str(one.key).endswith(second.key)).click().run()

    before = groups()
    press("Same fruit")
    assert groups() == before - 1
    press("Different fruit")
    assert groups() == before
    for left in (before - 1, before):
        next(button for button in test.button if button.label == "Undo").click().run()
        assert groups() == left


def tap(test: AppTest, label: str) -> None:
    next(button for button in test.button if button.label == label).click().run()
    assert not test.exception
    wait_for_jobs()


def test_a_stop_is_moved_deleted_and_both_are_undone(house: Path) -> None:
    def places() -> list[tuple[str | None, float | None]]:
        with open_store(house) as store:
            return [(stop.row, stop.position_m) for stop in store.stops(WALK)]

    before = places()
    with open_store(house) as store:
        first = store.stops(WALK)[0]
    test = app("row_map", round=WALK, **{f"stop_of_{WALK}": first.key})
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


def field(test: AppTest, kind: str, label: str) -> Any:
    return [one for one in getattr(test, kind) if one.label == label][-1]


def test_a_stop_that_the_address_names_is_opened(house: Path) -> None:
    with open_store(house) as store:
        stop = store.stops(WALK)[1]
    test = app("row_map", round=WALK, stop=stop.key)
    assert field(test, "number_input", "At [m]").value == stop.position_m


def test_what_was_typed_just_before_the_tap_is_saved(house: Path) -> None:
    with open_store(house) as store:
        first = store.stops(WALK)[0]
    test = app("row_map", round=WALK, **{f"stop_of_{WALK}": first.key})
    # No run between: the page was drawn before anything was typed.
    field(test, "text_input", "Row").set_value("12")
    field(test, "text_input", "Name").set_value("long leaf")
    tap(test, "Save")
    test.text_input(key=f"name_{WALK}").set_value("Evening")
    tap(test, "Rename")
    with open_store(house) as store:
        now = store.stops(WALK)[0]
        assert store.rounds()[0].record.name == "Evening"
    assert (now.row, now.note, now.position_m) == ("12", "long leaf", first.position_m)


def test_after_undo_the_fields_say_what_the_stop_says(house: Path) -> None:
    with open_store(house) as store:
        first = store.stops(WALK)[0]
        test = app("row_map", round=WALK, **{f"stop_of_{WALK}": first.key})
        field(test, "text_input", "Name").set_value("long leaf")
        tap(test, "Save")
        # Somebody else changes it too: undone after that, and not forgotten.
        later = store.place_stop(first.key, StopPlace("1", "left", -0.5, -1, "short leaf"))
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
        keys = [one.key for one in store.stops(WALK)]
        for at, (key, side) in enumerate(zip(keys, ("A", "B", "left"), strict=True)):
            store.place_stop(key, StopPlace("1", side, float(at), at))
    test = app("row_map", round=WALK, **{f"stop_of_{WALK}": keys[2]})
    assert "row '1' has 3 sides: A, B, left" in test.exception[0].message
    side = field(test, "selectbox", "Side")
    assert (side.options, side.value) == (["A", "B", "left"], "left")
    side.select("B")
    tap(test, "Save")
    assert not test.run().exception


def test_a_house_whose_sides_have_other_names_is_walked(house: Path) -> None:
    with open_store(house) as store:
        template = store.stop(store.stops(WALK)[0].key)
        round_for_capture(store, "", simulated=True)
        for side in ("A", "B"):
            stop = replace(template, key=key_of(side), round_key=DEMONSTRATION, side=side)
            store.save_stop(stop)
    test = app("upload", round=DEMONSTRATION)
    assert not test.exception
    control = field(test, "segmented_control", "Side")
    assert (control.options, control.value) == (["A", "B"], "B")


def test_undo_on_a_fruit_s_page_takes_a_deleted_stop_back_and_merges(house: Path) -> None:
    with open_store(house) as store:
        stop = store.stops(WALK)[0]
        fruit = next(one for one in store.detections(WALK) if one.stop_key != stop.key)
        store.delete_stop(stop.key)
        for page in ("results", "row_map"):
            test = app(page, round=WALK, fruit=fruit.key)
            tap(test, "Undo")
            put_back = store.stops(WALK)[0]
            assert put_back.key == stop.key
            assert put_back.fitted_m is not None
            store.place_stop(stop.key, StopPlace(stop.row, stop.side, 9.0, 1))


def test_fruit_turn_with_the_side_of_their_stop(store: Store) -> None:
    first = store.stops(WALK)[0]
    at_m = first.position_m or 0.0

    def offsets() -> list[float]:
        views = [view for view in store.detections(WALK) if view.stop_key == first.key]
        return [round((view.along_m or 0.0) - at_m, 6) for view in views]

    before = offsets()
    other = "left" if first.side == "right" else "right"
    move_stop(store, first, Stop(first.row, other, first.position_m, first.step))
    assert offsets() == [-x for x in before]
    turned = store.stops(WALK)[0]
    move_stop(store, turned, Stop(first.row, first.side, first.position_m, first.step))
    assert offsets() == before


def test_a_round_is_renamed_deleted_and_brought_back(house: Path) -> None:
    def rounds() -> list[str]:
        with open_store(house) as store:
            return [one.record.name for one in store.rounds()]

    test = app("results", round=WALK)
    test.text_input(key=f"name_{WALK}").set_value("Evening").run()
    tap(test, "Rename")
    assert rounds() == ["Evening"]
    tap(test, "Delete this round")
    assert rounds() == []
    assert "There is no round yet" in said(test)
    test.button(key=f"back_{WALK}").click().run()
    assert rounds() == ["Evening"]
    assert test.session_state["round"] == WALK


def test_a_round_that_captures_wait_for_is_not_deleted(house: Path) -> None:
    capture = next(iter(open_source(example_captures()))).load()
    one = resources.waiting().put(capture, new_key(), WALK, time.time())
    test = app("results", round=WALK)
    tap(test, "Delete this round")
    assert "1 capture waits to be measured into it" in said(test)
    resources.waiting().done(one)
    tap(test, "Delete this round")
    with open_store(house) as store:
        assert store.rounds() == []


def test_when_a_round_is_deleted_its_neighbours_are_linked(
    house: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    linked: list[tuple[str, str]] = []

    def link(store: Store, earlier: str, later: str, *rest: Any) -> object:
        linked.append((earlier, later))
        return link_rounds(store, earlier, later, *rest)

    monkeypatch.setattr("cucumbervision_greenhouse.rounds.merge_and_link.link_rounds", link)
    with open_store(house) as store:
        [walk] = store.rounds()
        keys = [WALK]
        for day in (1, 2):
            began_s = walk.record.started_s + day * 86400.0
            record = replace(walk.record, key=key_of("day", day), started_s=began_s)
            store.save_round(replace(record, name="![x](http://a)"))
            for view in store.stops(WALK):
                stop = replace(store.stop(view.key), key=new_key(), round_key=record.key)
                store.save_stop(replace(stop, taken_s=view.taken_s + day * 86400.0))
            keys.append(record.key)
        for key in keys:
            assert settle(store, key) == ""
        assert {one for one, later in linked if later == keys[2]} == {keys[1]}
        test = app("results", round=keys[1])
        tap(test, "Delete this round")
        assert (keys[0], keys[2]) in linked
    back = test.run().button(key=f"back_{keys[1]}").label
    assert back.startswith("Restore: \\!\\[x\\]\\(http\u2060\\://a\\)")


def test_the_example_says_that_it_is_being_measured(house: Path) -> None:
    with open_store(house) as store:
        round_for_capture(store, "", simulated=True)
    done = threading.Event()
    work = lambda _: done.wait(600)  # noqa: E731
    resources.worker().submit("Measuring the bundled captures", work, DEMONSTRATION)
    words = said(app("today", round=DEMONSTRATION))
    done.set()
    wait_for_jobs()
    assert "The example is being measured" in words
    assert "no stops yet" not in words
    assert "no stops yet" in said(app("today", round=DEMONSTRATION))


def test_every_page_counts_what_is_saved_of_its_round_alike(house: Path) -> None:
    empty = Round(key_of("empty"), "evening", "house 1")
    capture = next(iter(open_source(example_captures()))).load()
    with open_store(house) as store:
        store.save_round(empty)
        for number, key in enumerate([WALK, empty.key, empty.key, empty.key, WALK]):
            place = Stop("1", "left", 50.0 + number)
            waiting = replace(capture, stop=place, name=str(number))
            resources.waiting().put(waiting, key_of(number), key, 1_700_000_000.0 + number)
        busy = threading.Event()
        resources.worker().submit("Loading the networks", lambda _: busy.wait(600))
        told = "3 captures are saved, and none is measured yet"
        for page in ("today", "results"):
            words = said(app(page, round=empty.key))
            assert told in words
            assert "no stops yet" not in words
        walked = walk(store, empty.key, "camera")
        assert walked["first"].startswith(told)
        work = {"words": "Measuring: 0 of 3 captures; 2 of other rounds wait too"}
        assert walked["work"] == round_caches.news(empty.key)["work"]
        assert walked["work"] == {**work, "done": 0, "total": 3, "waiting": 3}
        assert "2 captures are still being measured" in said(app("today", round=WALK))
        assert round_caches.news(WALK)["work"]["waiting"] == 2
        for one in resources.waiting().captures():
            resources.waiting().done(one)
        busy.set()
        wait_for_jobs()
        assert "no stops yet" in said(app("results", round=empty.key))
        assert walk(store, empty.key, "camera")["first"] == ""


def test_why_nothing_is_measured_is_told_on_every_page(house: Path, tmp_path: Path) -> None:
    lost = tmp_path / "lost.json"
    resources.change_settings(calibration=str(lost))
    capture = next(iter(open_source(example_captures()))).load()
    place = Stop("1", "left", 50.0)
    resources.waiting().put(replace(capture, stop=place), key_of("lost"), WALK, time.time())
    assert app("today", round=WALK).exception == []
    wait_for_jobs()
    words = round_caches.news(WALK)["work"]["words"]
    assert words.startswith("1 capture waits to be measured: ")
    assert "lost.json" in words


def test_what_the_data_makes_doubtful_is_told_once_where_captures_come_in(house: Path) -> None:
    hollow = Round(key_of("hollow"), "relative depth", "house 1")
    with open_store(house) as store:
        store.save_round(hollow)
        for view in store.stops(WALK):
            stop = store.stop(view.key)
            doubted = [
                replace(one, fruit=tuple(replace(x, flags="depth-hollow") for x in one.fruit))
                for one in stop.captures
            ]
            new = replace(stop, key=new_key(), round_key=hollow.key, captures=tuple(doubted))
            store.save_stop(new)
        words = "8 of 8 fruit: the depth of their middle lies behind that of their flanks; check"
        assert said(app("upload", round=hollow.key)).count(words) == 1
        (line,) = walk(store, hollow.key, "camera")["doubts"]
        assert line.startswith(words)
        assert "8 of 8" not in said(app("upload", round=WALK))
        assert walk(store, WALK, "camera")["doubts"] == []


def test_a_deleted_demonstration_comes_back_with_the_next_drawn_capture(store: Store) -> None:
    round_for_capture(store, WALK, simulated=True)
    store.delete_round(DEMONSTRATION)
    assert round_for_capture(store, WALK, simulated=True) == DEMONSTRATION
    assert DEMONSTRATION in {one.key for one in store.rounds()}


def test_an_old_round_says_nothing_of_today(house: Path) -> None:
    with open_store(house) as store:
        template = store.stop(store.stops(WALK)[0].key)
        past = Round(name="past", started_s=1_700_000_000.0)
        store.save_round(past)
        stop = replace(template, key=new_key(), round_key=past.key, taken_s=past.started_s)
        store.save_stop(stop)
    test = app("today", round=past.key)
    assert "too old for today" in said(test)
    assert not test.metric


def test_today_counts_what_is_ready(house: Path) -> None:
    with open_store(house) as store:
        template = store.stop(store.stops(WALK)[1].key)
        fresh = Round(name="today", house="house 9", profile="long-cucumber")
        store.save_round(fresh)
        store.save_stop(
            replace(template, key=new_key(), round_key=fresh.key, taken_s=fresh.started_s)
        )
        ready = [
            view
            for view in store.detections(fresh.key)
            if 0.25 < (view.record.length_m or 0) < 0.40
        ]
    test = app("today", round=fresh.key)
    shown = {metric.label: metric.value for metric in test.metric}
    assert "Measured today" in said(test)
    assert int(shown["Ready today"]) + int(shown.get("Too long", 0)) >= len(ready) > 0


def test_preset_and_exposure_of_the_camera_are_chosen(house: Path) -> None:
    test = app("settings")
    next(box for box in test.selectbox if box.label == "Depth preset").select("hand").run()
    exposure = next(box for box in test.selectbox if box.label.startswith("Exposure"))
    exposure.select("fixed").run()
    next(box for box in test.number_input if box.label == "Microseconds").set_value(5000.0).run()
    assert not test.exception
    assert resources.settings().camera == CameraSettings("hand", 5000.0)


def test_a_round_is_begun(house: Path) -> None:
    test = app("today")
    test.text_input(key="new_name").set_value("Evening").run()
    next(b for b in test.button if b.label == "Start this round").click().run()
    with open_store(house) as store:
        newest = store.rounds()[0]
        assert newest.record.name == "Evening"
        assert newest.record.profile == "long-cucumber"
    assert test.session_state["round"] == newest.key


def test_a_house_is_chosen_of_the_known_ones_and_one_by_another_name_is_told(house: Path) -> None:
    test = app("today")
    known = test.selectbox(key="known_house")
    assert known.options == ["house 1", "New house …"]
    next(b for b in test.button if b.label == "Start this round").click().run()
    known = test.selectbox(key="known_house")
    known.select("New house …").run()
    test.text_input(key="new_house").set_value("1\u202e").run()
    next(b for b in test.button if b.label == "Start this round").click().run()
    assert "U+202E" in said(test)
    test.text_input(key="new_house").set_value("HOUSE  1").run()
    next(b for b in test.button if b.label == "Start this round").click().run()
    assert "'house 1', which is known" in test.toast[0].value
    with open_store(house) as store:
        assert [one.record.house for one in store.rounds()] == ["house 1"] * 3


def test_a_round_that_was_left_is_not_opened_again_by_an_older_address(house: Path) -> None:
    script = (
        "from cucumbervision_greenhouse.dashboard.app import read_address\n"
        "from cucumbervision_greenhouse.dashboard.round_choice import choose_round\n"
        "read_address()\nchoose_round()\n"
    )
    test = AppTest.from_string(script, default_timeout=600)
    test.query_params["round"] = WALK
    test.run()
    test.text_input(key="new_name").set_value("Monday").run()
    next(b for b in test.button if b.label == "Start this round").click().run()
    begun = test.session_state["round"]
    assert test.query_params["round"] == begun
    # What a page sent before it knew the new address.
    test.query_params["round"] = WALK
    assert test.run().session_state["round"] == begun
    assert test.query_params["round"] == begun
    # Once it has it, going back opens the round of before.
    test.run()
    test.query_params["round"] = WALK
    assert test.run().session_state["round"] == WALK


def test_inches_are_shown_where_chosen(house: Path) -> None:
    test = app("settings")
    control = next(c for c in test.segmented_control if c.label == "Lengths in")
    control.set_value("in").run()
    assert resources.settings().unit == "in"
    limits = test.table[0].value
    assert [cell.replace("\\", "") for cell in limits["From"]] == [
        "9.84 in",
        "7.87 in",
    ]  # 25 and 20 cm
    shown = {metric.label: metric.value for metric in app("results").metric}
    assert shown["Mean length"].endswith(" in")


@pytest.mark.parametrize("offer", ["https://git.example/ours", "ask at the office"])
def test_the_source_is_offered(offer: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CUCUMBERVISION_SOURCE", offer)
    test = app("about")
    assert "AGPL-3.0-only" in said(test)
    links = [one.proto.url for one in test.get("link_button")]
    assert links == [offer] if offer.startswith("http") else offer in said(test)


@pytest.mark.parametrize(("sent", "drawn"), [("first", "second"), ("third", "third"), ("", "None")])
def test_news_of_a_slow_browser_do_not_close_a_fruit(sent: str, drawn: str) -> None:
    script = (
        "from types import SimpleNamespace\nimport streamlit as st\n"
        "from cucumbervision_greenhouse.dashboard import page_elements\n"
        "page_elements.name_in_address('fruit', 'second')\n"
        # The browser sent its news from the first fruit, and maybe a link since then.
        f"st.query_params.from_dict({ {'fruit': sent} if sent else {} })\n"
        "st.session_state['live'] = SimpleNamespace(changed={'at': '?fruit=first'})\n"
        "page_elements.keep_address()\n"
        "st.write(str(st.query_params.get('fruit')))\n"
    )
    test = AppTest.from_string(script, default_timeout=600).run()
    assert not test.exception
    assert test.markdown[0].value == drawn


def test_every_page_opens_on_500_stops(
    house: Path, make_long: Callable[[Store, StopRecord, int], None]
) -> None:
    with open_store(house) as store:
        template = store.stop(store.stops(WALK)[0].key)
        make_long(store, template, 500)
    for page in ("results", "row_map", "forecast", "accuracy"):
        test = app(page, round=LONG, source="replay")
        assert not test.exception
        if page == "results":
            assert next(m.value for m in test.metric if m.label == "Fruit") == "2500"
        if page == "row_map":
            drawn = [
                one for one in test.get("bidi_component") if "picture" in one.proto.component_name
            ]
            marks = [
                mark["key"]
                for one in drawn
                for layer in json.loads(one.proto.json)["layers"]
                for mark in layer["shapes"]
            ]
            assert len(set(marks)) == len(marks) == 2500


def test_the_forecast_names_days_by_their_dates(house: Path) -> None:
    test = app("forecast")
    days = list(test.table[0].value.iloc[:, 0])
    in_two_days = time.localtime(time.time() + 2 * 86400)
    assert days[:3] == ["today", "tomorrow", time.strftime("%a %-d %b", in_two_days)]
    # Some of the eight bundled fruit are class I as they were measured.
    assert "class I today" in said(test)


def test_looking_at_another_crop_changes_nothing(house: Path) -> None:
    test = app("settings")
    crop = next(box for box in test.selectbox if box.label == "Crop")
    crop.select("courgette").run()
    assert resources.settings().profile == "long-cucumber"
    tap(test, "Use for new rounds")
    assert resources.settings().profile == "courgette"
    # The round that was begun keeps its crop.
    [round_summary] = resources.rounds()
    assert resources.profile_of(round_summary)[0] == "long-cucumber"


def test_own_limits_are_previewed_saved_and_graded_by(
    house: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CUCUMBERVISION_PROFILES", str(tmp_path / "own"))
    test = app("settings")

    def preview() -> dict[str, int]:
        [table] = [x.value for x in test.table if "With these limits" in x.value.columns]
        return dict(zip(table["Class"], map(int, table["With these limits"]), strict=True))

    before = preview()
    assert sum(before.values()) == 8
    lowest = next(x for x in test.number_input if "from" in x.label and "II" in x.label)
    lowest.set_value(11.0).run()
    after = preview()
    assert sum(after.values()) == 8
    assert after["class II"] > before["class II"]
    next(x for x in test.text_input if x.label == "Name of your crop").input("Ours").run()
    tap(test, "Save and use for new rounds")
    assert not test.exception
    assert resources.settings().profile == "ours"
    record = Round(name="next", profile=resources.settings().profile)
    with open_store(house) as store:
        store.save_round(record)
        saved = next(x for x in store.rounds() if x.key == record.key)
    assert resources.profile_of(saved)[1].classes[-1].min_cm == 11.0


def test_a_calibration_is_made_used_and_put_back_on_the_page(house: Path) -> None:
    with open_store(house) as store:
        fruit = store.detections(WALK)
    lengths = {view.key: (1.1 * (view.record.length_m or 0.0), None) for view in fruit}
    write_hand_lengths(hand_file(str(house), WALK), fruit, lengths, LengthDefinition.CENTRELINE)
    test = app("accuracy", round=WALK)
    assert "too short on average" in said(test)
    tap(test, "Calibrate with these lengths")
    assert not test.exception
    assert "Lengths change by +10.0 %" in said(test)
    tap(test, "Use it now")
    chosen = resources.settings().calibration
    assert read_site_calibration(Path(chosen)).name == "my house"
    assert "In use: my house" in said(test)
    tap(app("settings"), "Use none")
    assert resources.settings().calibration == ""


def test_a_house_is_renamed_and_merged_on_the_page(house: Path) -> None:
    second = Round(new_key(), "second", "North", time.time() - 5 * 86400)
    with open_store(house) as store:
        store.save_round(second)

    def houses() -> list[str]:
        with open_store(house) as store:
            return sorted(x.record.house for x in store.rounds())

    test = app("today", round=WALK, changing_round=True)
    field = next(x for x in test.text_input if x.label == "House")
    field.input("South").run()
    tap(test, "Rename the house (1 round)")
    assert houses() == ["North", "South"]
    test = app("today", round=WALK, changing_round=True)
    next(x for x in test.text_input if x.label == "House").input("north").run()
    tap(test, "Merge the house with 'North' (1 round)")
    assert houses() == ["North", "North"]
    wait_for_jobs()
