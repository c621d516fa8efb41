from __future__ import annotations

import time
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("streamlit")

import streamlit as st
from streamlit.testing.v1 import AppTest

from cucumbervision.dashboard import resources
from cucumbervision.store.records import StopRecord, key_of
from cucumbervision.store.repository import Store, open_store
from cucumbervision.store.views import Verdict

WALK, LONG = key_of("walk"), key_of("long walk")
PAGES = ("capture", "upload", "results", "row_map", "forecast", "accuracy", "settings")


@pytest.fixture(autouse=True)
def _fresh() -> Iterator[None]:
    """Each test opens its own store, and lets it go."""
    st.cache_resource.clear()
    st.cache_data.clear()
    yield
    st.cache_resource.clear()
    st.cache_data.clear()


def app(page: str, **state: Any) -> AppTest:
    script = (
        "from cucumbervision.dashboard.app import keep_inputs\n"
        f"from cucumbervision.dashboard.views import {page}\n"
        f"keep_inputs()\n{page}.page()\n"
    )
    test = AppTest.from_string(script, default_timeout=600)
    for name, value in state.items():
        test.session_state[name] = value
    return test.run()


def said(test: AppTest) -> str:
    parts = [*test.info, *test.warning, *test.error, *test.success, *test.markdown, *test.caption]
    return "\n".join(str(part.value) for part in parts)


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
    # Mean of the eight bundled fruit over the thread, as drawn: 24.1 cm.
    assert float(shown["Mean length"].split()[0]) == pytest.approx(24.1, abs=0.6)
    table = test.dataframe[0].value
    assert len(table) == 8
    assert set(table["Class"]) == {"class I", "class II", "out of grade"}


def test_filters_leave_fruit_out(house: Path) -> None:
    test = app("results")
    chosen = next(box for box in test.selectbox if box.label == "Class")
    chosen.select("class I").run()
    assert set(test.dataframe[0].value["Class"]) == {"class I"}


def test_a_fruit_is_accepted_picked_and_both_are_undone(house: Path) -> None:
    with open_store(house) as store:
        key = store.detections(WALK)[0].key
    test = app("results", fruit=key)
    assert not test.exception

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
    assert "nothing to take back" in said(test)


def test_the_other_finds_of_a_picture_are_accepted_at_once(house: Path) -> None:
    with open_store(house) as store:
        first, *_ = views = store.detections(WALK)
    test = app("results", fruit=first.key)
    label = "All other finds in this picture are right"
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
    assert test.session_state["fruit"] == keys[1]
    next(b for b in test.button if b.label == "All fruit").click().run()
    assert any(metric.label == "Mean length" for metric in test.metric)


def test_a_capture_from_the_replay_becomes_a_stop(house: Path) -> None:
    resources.change_settings(fruit_from="dataset")
    test = app("capture", source="replay", row="9", side="right", position_m=2.0, step_m=0.4)
    next(button for button in test.button if button.label == "Capture").click().run()
    wait_for_jobs()
    test.run()
    assert test.session_state["position_m"] == 2.4
    with open_store(house) as store:
        taken = [stop for stop in store.stops(WALK) if stop.row == "9"]
        assert [(stop.side, stop.position_m, stop.fruit) for stop in taken] == [("right", 2.0, 3)]
    assert "Row 9, right, 2.00 m: saved" in said(test)
    lengths = test.dataframe[-1].value["Length"]
    assert all(text.endswith(" cm") for text in lengths)


def test_the_absent_camera_is_told_and_the_replay_offered(
    house: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rs = pytest.importorskip("pyrealsense2")
    if len(rs.context().query_devices()):
        pytest.skip("a camera is connected")
    while resources.camera().preview().state == "opening":
        time.sleep(0.05)  # until the test's own limit
    test = app("capture", source="camera", source_chosen=True)
    assert "No camera was found" in said(test)
    assert "choose 'Replay'" in said(test)
    # Who chose nothing is shown the replay at once.
    assert app("capture", source="camera").session_state["source"] == "replay"


def test_a_round_is_begun(house: Path) -> None:
    test = app("capture", source="replay")
    test.text_input(key="new_name").set_value("Evening").run()
    next(b for b in test.button if b.label == "Begin this round").click().run()
    with open_store(house) as store:
        newest = store.rounds()[0]
        assert newest.record.name == "Evening"
        assert newest.record.profile == "long-cucumber"
    assert test.session_state["round"] == newest.key


def test_a_round_is_written_as_files(house: Path) -> None:
    test = app("results")
    next(b for b in test.button if b.label == "Make the files").click().run()
    wait_for_jobs()
    test.run()
    assert not test.error
    job = resources.worker().get(test.session_state[f"export_{WALK}"])
    assert job is not None
    with zipfile.ZipFile(job.result) as archive:
        names = archive.namelist()
    assert any(name.endswith(".xlsx") for name in names)
    assert "fruit.csv" in names
    assert "round.html" in names


def test_inches_are_shown_where_chosen(house: Path) -> None:
    test = app("settings")
    control = next(c for c in test.segmented_control if c.label == "Lengths in")
    control.set_value("in").run()
    assert resources.settings().unit == "in"
    shown = {metric.label: metric.value for metric in app("results").metric}
    assert shown["Mean length"].endswith(" in")


def test_the_pick_list_marks_its_fruit_as_picked(house: Path) -> None:
    test = app("forecast")
    ready = next(text.value for text in test.markdown if "ready today" in text.value)
    assert "4 fruit" in ready  # the profile picks class I
    next(b for b in test.button if b.label == "Mark all as picked").click().run()
    with open_store(house) as store:
        assert sum(view.picked_s is not None for view in store.detections(WALK)) == 4


def test_the_source_is_offered_on_every_page(house: Path) -> None:
    script = "from cucumbervision.dashboard import app\napp.footer()\n"
    test = AppTest.from_string(script, default_timeout=600).run()
    assert "AGPL-3.0-only" in test.caption[0].value
    assert "source code" in test.caption[0].value


def test_every_page_opens_on_500_stops(
    house: Path, make_long: Callable[[Store, StopRecord, int], None]
) -> None:
    with open_store(house) as store:
        template = store.stop(store.stops(WALK)[0].key)
        make_long(store, template, 500)
    for page in ("results", "row_map", "forecast", "accuracy", "capture"):
        test = app(page, round=LONG, source="replay")
        assert not test.exception
        if page == "results":
            assert next(m.value for m in test.metric if m.label == "Fruit") == "2500"
