from __future__ import annotations

import json
import re
import shutil
import time
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

pytest.importorskip("streamlit")

from tests.greenhouse.conftest import copy_round, shot, wait_until
from tests.greenhouse.pages.app_pages import WALK, app, said, tap

from cucumbervision.capture.source import example_captures
from cucumbervision_greenhouse.store.records import LinkKind, LinkRecord, Round
from cucumbervision_greenhouse.store.repository import open_store


@pytest.mark.usefixtures("fresh_caches")
def test_a_pair_that_may_be_one_fruit_is_offered_until_it_is_confirmed(house: Path) -> None:
    with open_store(house) as store:
        [walk] = [x for x in store.rounds() if x.key == WALK]
        later = Round(name="later", house="house 1", started_s=walk.walked_s + 86400.0)
        copy_round(store, later, 86400.0)
        first, second = (store.detections(key)[0].key for key in (WALK, later.key))
        store.save_growth(WALK, later.key, [LinkRecord(LinkKind.GROWTH, first, second, 0.7)])
    test = app("days", round=later.key)
    new = int({x.label: x.value for x in test.metric}["New"])
    assert "1 pair may be one fruit" in said(test)
    tap(test, "The same fruit")
    assert "may be one fruit" not in said(test)
    assert {x.label: x.value for x in test.metric}["New"] == str(new - 1)
    tap(test, "Undo")
    assert "1 pair may be one fruit" in said(test)


GROWTH = 1.08  # in a day, of every length
DAY_S = 86400.0


def pack_day(folder: Path, taken_s: float, scale: float, gone: tuple[str, ...] = ()) -> Path:
    """Pack the bundled captures as recorded at a time; all lengths are `scale` times as long."""
    shutil.copytree(example_captures(), folder)
    for path in sorted(folder.rglob("capture.json")):
        manifest = json.loads(path.read_text(encoding="utf-8"))
        for number, frame in enumerate(manifest["frames"]):
            frame["timestamp_s"] = taken_s + 60.0 * manifest["stop"]["step"] + 0.03 * number
        at_m = round(scale * manifest["stop"]["position_m"], 3)
        stop = {**manifest["stop"], "row": "3", "position_m": at_m}
        path.write_text(json.dumps({**manifest, "simulated": False, "stop": stop}))
    for path in folder.rglob("depth_*.png"):
        depth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        assert depth is not None
        cv2.imwrite(str(path), np.rint(depth * scale).astype(depth.dtype))
    for name in gone:
        (folder / name).unlink()
    packed = folder.with_suffix(".zip")
    with zipfile.ZipFile(packed, "w") as archive:
        for path in sorted(folder.rglob("*.*")):
            archive.write(path, path.relative_to(folder))
    return packed


def begin_round(page: Any, name: str) -> None:
    page.get_by_role("button", name="New round").click()
    field = page.get_by_label("Name", exact=True).first
    field.fill(name)
    field.press("Enter")
    page.locator("[data-test-script-state=notRunning]").wait_for()
    page.get_by_role("button", name="Start this round").click()
    page.get_by_role("dialog").wait_for(state="hidden")
    page.get_by_text("This round has no stops yet").wait_for()


def upload(page: Any, packed: Path) -> None:
    page.get_by_role("link", name="Upload").first.click()
    page.locator("input[type=file]").set_input_files(packed)
    page.get_by_role("button", name="Measure these files").click()
    page.get_by_text("3 captures saved").wait_for()


def wait_for_fruit(page: Any, store: Path, name: str, number: int) -> None:
    """Wait until a round's captures are measured, and its views merged."""
    with open_store(store) as opened:
        key = next(x.key for x in opened.rounds() if x.name == name)
        wait_until(page, lambda: sum(view.best for view in opened.detections(key)) == number)


def metrics(page: Any) -> dict[str, str]:
    drawn = page.get_by_test_id("stMetric")
    drawn.first.wait_for()
    return {
        box.get_by_test_id("stMetricLabel").inner_text(): box.get_by_test_id(
            "stMetricValue"
        ).inner_text()
        for box in drawn.all()
    }


def test_two_days_from_upload_to_comparison(
    tmp_path: Path, start_server: Callable[..., Any], new_page: Callable[..., Any]
) -> None:
    now_s = time.time()
    monday = pack_day(tmp_path / "monday", now_s - DAY_S - 600, 1.0)
    tuesday = pack_day(
        tmp_path / "tuesday",
        now_s - 600,
        GROWTH,
        gone=("simulated-row-a/mask_visib/000000_000000.png",),
    )
    store = tmp_path / "house.db"
    address = start_server(tmp_path, "--store", str(store))
    page = new_page(1280, 900)
    page.goto(address)

    # The first day: upload, and pick a fruit.
    begin_round(page, "Monday")
    upload(page, monday)
    wait_for_fruit(page, store, "Monday", 8)
    page.get_by_role("link", name="Days").first.click()
    page.get_by_text("Nothing to compare yet").wait_for()
    page.get_by_role("link", name="Today").first.click()
    page.locator(".fruit button").first.click()
    page.get_by_text(re.compile(r"^1 of \d+ picked")).wait_for()

    # The second day: the links between the days are made by themselves.
    begin_round(page, "Tuesday")
    upload(page, tuesday)
    wait_for_fruit(page, store, "Tuesday", 7)
    page.get_by_role("link", name="Days").first.click()
    page.get_by_text("Compare with").wait_for()
    page.get_by_test_id("stMetricValue").filter(has_text=re.compile("^7$")).first.wait_for()
    page.locator("[data-test-script-state=notRunning]").wait_for()
    page.get_by_text("No fruit of one day is surely").wait_for(state="hidden")  # until linked
    shot(page, "days-compare", full_page=True)
    told = metrics(page)
    with open_store(store) as opened:
        first, last = (
            next(x for x in opened.rounds() if x.name == name) for name in ("Monday", "Tuesday")
        )
        sizes = [
            sum(view.best for view in opened.detections(round_summary.key))
            for round_summary in (first, last)
        ]
    before, after = (int(told[label]) for label in told if label.startswith("On "))
    assert [before, after] == sizes == [8, 7]
    stayed = before - int(told["Picked"]) - int(told["Not seen again"])
    assert after == stayed + int(told["New"])
    assert stayed >= 5
    # Eight bundled fruit of 21 cm in the middle, which grew by 8 %.
    assert float(told["Growth"].split()[0]) == pytest.approx(0.08 * 21, rel=0.3)

    # One fruit on both days.
    page.locator(".fruit button").first.click()
    page.get_by_text(re.compile(r": 2 days$")).wait_for()
    shot(page, "days-fruit", full_page=True)
    assert "fruit=" in page.url
    page.get_by_role("button", name="All fruit").click()
    page.get_by_text("Compare with").wait_for()
    page.locator("[data-test-script-state=notRunning]").wait_for()
    page.get_by_text("All days of House 1").click()
    page.get_by_text("Fruit that the last round of each day showed").wait_for()
    page.locator(".vega-embed canvas, .vega-embed svg").first.wait_for()
    shot(page, "days-trend", full_page=True)


START_AT_ONCE = """async () => {
  const button = (place, words) =>
    [...document.querySelectorAll(`${place} button`)].find(x => x.innerText.includes(words));
  button('', 'New round').click();
  for (let i = 0; i < 1000 && !button('[role=dialog]', 'Start this round'); i++)
    await new Promise(drawn => setTimeout(drawn, 5));
  button('[role=dialog]', 'Start this round').click();
}"""
"""Open the form and press its button before the server has drawn the page with the form open."""


def test_the_form_of_a_round_closes_however_fast_it_is_sent(
    tmp_path: Path, start_server: Callable[..., Any], new_page: Callable[..., Any]
) -> None:
    store = tmp_path / "house.db"
    page = new_page(1280, 900)
    page.goto(start_server(tmp_path, "--store", str(store)))
    page.get_by_role("button", name="New round").wait_for()
    for count in range(1, 5):
        page.locator("[data-test-script-state=notRunning]").wait_for()
        page.evaluate(START_AT_ONCE)
        page.get_by_role("dialog").wait_for(state="hidden", timeout=60_000)
        page.locator("[data-test-script-state=notRunning]").wait_for()
        with open_store(store) as opened:
            assert sum(x.name == "Morning round" for x in opened.rounds()) == count
