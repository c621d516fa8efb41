from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("streamlit")


from tests.greenhouse.dashboard.app_pages import WALK, app, said

from cucumbervision_greenhouse.store.repository import open_store

pytestmark = pytest.mark.usefixtures("fresh_caches")


def test_the_row_map_tells_two_fruit_from_one_and_takes_that_back(house: Path) -> None:
    with open_store(house) as store:
        first, second, *_ = store.detections(WALK)
    test = app("row_map", round=WALK, fruit=first.key)
    assert not test.exception
    assert "fruit found" in said(test)

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
