from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("streamlit")

from streamlit.testing.v1 import AppTest
from tests.greenhouse.conftest import copy_round
from tests.greenhouse.pages.app_pages import PAGES, WALK, app, field, said, tap, wait_for_jobs

from cucumbervision.capture.readers import open_source
from cucumbervision.capture.source import example_captures
from cucumbervision_greenhouse import resources
from cucumbervision_greenhouse.rounds.merge_and_link import link_rounds, settle
from cucumbervision_greenhouse.store.records import Round, key_of, new_key
from cucumbervision_greenhouse.store.repository import Store, open_store

pytestmark = pytest.mark.usefixtures("fresh_caches")


@pytest.mark.parametrize("page", [page for page in PAGES if page != "settings"])
def test_an_address_of_no_round_shows_no_other_one(page: str, house: Path) -> None:
    test = app(page, round="nonsense")
    assert "There is no round 'nonsense'" in said(test)
    assert not [*test.metric, *test.button_group, *test.get("bidi_component")]
    test.run()  # drawn anew, as by news
    assert "There is no round 'nonsense'" in said(test)
    test.selectbox(key="round").select(WALK).run()
    assert "nonsense" not in said(test)


def test_a_round_is_renamed_deleted_and_brought_back(house: Path) -> None:
    def rounds() -> list[str]:
        with open_store(house) as store:
            return [one.name for one in store.rounds()]

    test = app("results", round=WALK)
    field(test, "text_input", "Name of this round").set_value("Evening").run()
    tap(test, "Rename")
    assert rounds() == ["Evening"]
    tap(test, "Delete this round")
    assert rounds() == []
    assert "There is no round yet" in said(test)
    test.button(key=f"back_{WALK}").click().run()
    assert rounds() == ["Evening"]
    assert test.session_state["round"] == WALK


def test_the_names_that_another_viewer_gives_are_shown(house: Path) -> None:
    test = app("results", round=WALK)
    with open_store(house) as store:
        store.rename_round(WALK, "Evening")
        store.move_rounds([WALK], "North")
    test.run()
    fields = [field(test, "text_input", name) for name in ("Name of this round", "House")]
    assert [one.value for one in fields] == ["Evening", "North"]
    assert not [button for button in test.button if "house" in button.label]
    fields[1].set_value("South").run()
    assert field(test, "text_input", "House").value == "South"


def test_a_name_that_another_viewer_has_changed_meanwhile_is_not_overwritten(house: Path) -> None:
    first, second = app("results", round=WALK), app("results", round=WALK)
    for test, name in ((second, "Evening"), (first, "Noon")):
        field(test, "text_input", "Name of this round").set_value(name).run()
    tap(first, "Rename")
    tap(second, "Rename")
    assert "changed it meanwhile" in said(second)
    assert field(second, "text_input", "Name of this round").value == "Noon"
    for test, name in ((second, "South"), (first, "North")):
        field(test, "text_input", "House").set_value(name).run()
    tap(first, "Rename the house (1 round)")
    tap(second, "Rename the house (1 round)")
    assert "changed it meanwhile" in said(second)
    with open_store(house) as store:
        [record] = list(store.rounds())
    assert (record.name, record.house) == ("Noon", "North")


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
            began_s = walk.started_s + day * 86400.0
            record = replace(walk, key=key_of("day", day), started_s=began_s)
            copy_round(store, replace(record, name="![x](http://a)"), day * 86400.0)
            keys.append(record.key)
        for key in keys:
            assert settle(store, key) == ""
        assert {one for one, later in linked if later == keys[2]} == {keys[1]}
        test = app("results", round=keys[1])
        tap(test, "Delete this round")
        assert (keys[0], keys[2]) in linked
    back = test.run().button(key=f"back_{keys[1]}").label
    assert back.startswith("Restore: \\!\\[x\\]\\(http\u2060\\://a\\)")


def test_a_round_is_begun(house: Path) -> None:
    test = app("today")
    test.text_input(key="new_name").set_value("Evening").run()
    next(b for b in test.button if b.label == "Start this round").click().run()
    with open_store(house) as store:
        newest = store.rounds()[0]
        assert newest.name == "Evening"
        assert newest.profile == "long-cucumber"
    assert test.session_state["round"] == newest.key


def test_a_house_is_chosen_of_the_known_ones_and_one_by_another_name_is_told(house: Path) -> None:
    with open_store(house) as store:
        store.save_round(Round(key_of("north"), "old", "North", 1_600_000_000.0))
    test = app("today")
    assert test.text_input(key="new_house").value == "house 1"
    next(x for x in test.button_group if x.key == "known_house").select("North").run()
    next(b for b in test.button if b.label == "Start this round").click().run()
    test.text_input(key="new_house").set_value("1\u202e").run()
    next(b for b in test.button if b.label == "Start this round").click().run()
    assert "U+202E" in said(test)
    test.text_input(key="new_house").set_value("HOUSE  1").run()
    next(b for b in test.button if b.label == "Start this round").click().run()
    assert "'house 1', which is known" in test.toast[0].value
    with open_store(house) as store:
        assert [one.house for one in store.rounds()] == ["house 1", "North", "house 1", "North"]


def test_a_round_that_was_left_is_not_opened_again_by_an_older_address(house: Path) -> None:
    script = (
        "from cucumbervision_greenhouse.pages.app import read_address\n"
        "from cucumbervision_greenhouse.pages.round_choice import choose_round\n"
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


def test_a_house_is_renamed_and_merged_on_the_page(house: Path) -> None:
    second = Round(new_key(), "second", "North", time.time() - 5 * 86400)
    with open_store(house) as store:
        store.save_round(second)

    def houses() -> list[str]:
        with open_store(house) as store:
            return sorted(x.house for x in store.rounds())

    test = app("today", round=WALK, change_0=True)
    field(test, "text_input", "House").input("South").run()
    tap(test, "Rename the house (1 round)")
    assert houses() == ["North", "South"]
    test = app("today", round=WALK, change_0=True)
    field(test, "text_input", "House").input("north").run()
    tap(test, "Merge the house with 'North' (1 round)")
    assert houses() == ["North", "North"]
    wait_for_jobs()


@pytest.mark.parametrize("address", ["/", "/capture"])
def test_a_typed_house_is_the_house_of_the_round(
    address: str, tmp_path: Path, start_server: Callable[..., Any], new_page: Callable[..., Any]
) -> None:
    path = tmp_path / "house.db"
    with open_store(path) as store:
        store.save_round(Round(key_of("a"), "Monday", "house 1", 1_700_000_000.0, "long-cucumber"))
    page = new_page()
    page.goto(start_server(tmp_path, "--store", str(path)) + address)
    page.get_by_role("button", name="New round").click()
    form = page.get_by_role("dialog")
    form.get_by_label("House", exact=True).click()
    page.keyboard.press("ControlOrMeta+A")
    page.keyboard.type("House 7")
    form.get_by_role("button", name="Start this round").click()
    form.wait_for(state="hidden")
    page.get_by_text("House 7").first.wait_for()
    with open_store(path) as store:
        assert sorted(x.house for x in store.rounds()) == ["House 7", "house 1"]


def _choice() -> None:
    import streamlit as st

    from cucumbervision_greenhouse.pages.round_choice import label_options

    st.session_state["stops"] = st.session_state.get("stops", 0) + 1  # more with every run
    names = dict.fromkeys(("a", "b", "c"), f"Round, {st.session_state['stops']} stops")
    st.selectbox("Round", list(names), format_func=label_options("round", names), key="round")


def test_what_is_called_alike_is_told_apart_and_a_name_of_before_is_understood() -> None:
    page = AppTest.from_function(_choice, default_timeout=300).run()
    for key in ("c", "b", "a", "b"):
        page.selectbox[0].select(key).run()
        assert not page.exception
        assert page.session_state["round"] == page.selectbox[0].value == key
