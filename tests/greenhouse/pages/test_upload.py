from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from tests.greenhouse.conftest import whole_stop

pytest.importorskip("streamlit")


from tests.greenhouse.pages.app_pages import WALK, app, field, said

from cucumbervision.names import LONGEST_NAME
from cucumbervision_greenhouse.camera.page import walk
from cucumbervision_greenhouse.rounds.walking import DEMONSTRATION, round_for_capture
from cucumbervision_greenhouse.store.records import Round, StopRecord, key_of, new_key
from cucumbervision_greenhouse.store.repository import Store, open_store

pytestmark = pytest.mark.usefixtures("fresh_caches")


def test_another_row_of_an_upload_begins_at_its_own_place_and_outlives_a_reload(
    store: Store, house: Path
) -> None:
    for step, row, at_m in ((11, "7", 3.0), (12, "7", 3.5), (13, "1", 8.0), (14, "1", 8.4)):
        store.save_stop(StopRecord(row, "left", at_m, step, key_of(step), WALK, taken_s=2e9))
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
    store.save_stop(StopRecord("1", "left", 8.8, 15, key_of(15), WALK, taken_s=2e9))
    test.run()
    assert place() == ["new", 2.5, 0.4]
    again = app("upload", row=test.query_params["row"])
    assert field(again, "text_input", "Row").value == "new"


def test_a_house_whose_sides_have_other_names_is_walked(house: Path) -> None:
    with open_store(house) as store:
        template = whole_stop(store, store.stops(WALK)[0].key)
        round_for_capture(store, "", simulated=True)
        for side in ("A", "B"):
            stop = replace(template, key=key_of(side), round_key=DEMONSTRATION, side=side)
            store.save_stop(stop)
    test = app("upload", round=DEMONSTRATION)
    assert not test.exception
    control = field(test, "segmented_control", "Side")
    assert (control.options, control.value) == (["A", "B"], "B")


def test_what_the_data_makes_doubtful_is_told_once_where_captures_come_in(house: Path) -> None:
    hollow = Round(key_of("hollow"), "relative depth", "house 1")
    with open_store(house) as store:
        store.save_round(hollow)
        for view in store.stops(WALK):
            stop = whole_stop(store, view.key)
            doubted = [
                replace(one, fruit=tuple(x.with_(flags="depth-hollow") for x in one.fruit))
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


def test_a_row_of_the_address_may_be_too_long(house: Path) -> None:
    test = app("upload", row="x" * 10_000)
    assert not test.exception
    assert field(test, "text_input", "Row").value == "x" * LONGEST_NAME
