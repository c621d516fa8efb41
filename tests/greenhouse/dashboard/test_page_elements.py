from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("streamlit")

from streamlit.testing.v1 import AppTest
from tests.greenhouse.dashboard.app_pages import (
    WALK,
    app,
    said,
    tap,
)

from cucumbervision_greenhouse.store.repository import open_store
from cucumbervision_greenhouse.store.views import Verdict

pytestmark = pytest.mark.usefixtures("fresh_caches")


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
