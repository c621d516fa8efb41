"""Two pages of one browser: what one of them did not send before it was closed, the other sends."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from tests.greenhouse.conftest import PATIENCE_S

pytest.importorskip("streamlit")

from cucumbervision.capture.source import example_captures
from cucumbervision_greenhouse.store.records import Round, key_of
from cucumbervision_greenhouse.store.repository import open_store
from cucumbervision_greenhouse.store.waiting import WaitingCaptures, waiting_folder

WALK = Round(key_of("tabs"), "tabs", "", 1_700_000_000.0, "long-cucumber")

pytestmark = [pytest.mark.timeout(1800), pytest.mark.xdist_group("browser")]


def kept(path: Path) -> set[str]:
    """Return the keys of all presses that are stops or wait to be measured."""
    waiting = WaitingCaptures(waiting_folder(str(path)))
    with open_store(path) as store:
        stops = {stop.key for one in store.rounds() for stop in store.stops(one.key)}
    return stops | {one.key for one in (*waiting.captures(), *waiting.set_aside())}


def test_presses_of_a_page_that_was_closed_offline_are_sent_by_another(
    tmp_path: Path, start_server: Callable[..., Any], browser: Any
) -> None:
    path = tmp_path / "house.db"
    with open_store(path) as store:
        store.save_round(WALK)
    address = start_server(tmp_path, "--store", str(path), "--replay", str(example_captures()))
    context = browser.new_context()
    first, second = context.new_page(), context.new_page()
    for page in (first, second):
        page.set_default_timeout(1000 * PATIENCE_S)
        page.goto(f"{address}/capture?round={WALK.key}")
        page.locator("button.take:enabled").wait_for()
    context.set_offline(True)
    for page in (first, second):
        page.locator("button.take").click()
        page.get_by_text("waiting on this device").wait_for()
    second.close()
    context.set_offline(False)
    until = time.monotonic() + PATIENCE_S
    while len(kept(path)) < 2 and time.monotonic() < until:
        first.wait_for_timeout(500)
    first.wait_for_timeout(3000)  # one too many would come now
    assert len(kept(path)) == 2
    context.close()
