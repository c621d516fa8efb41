"""A typed house is the house of the round, however fast the form is sent."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("streamlit")

from cucumbervision_greenhouse.store.records import Round, key_of
from cucumbervision_greenhouse.store.repository import open_store


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
