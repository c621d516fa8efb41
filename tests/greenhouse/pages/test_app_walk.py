"""A day in the house, in Chromium: a walk with a tablet, a phone beside it, a kill in between."""

from __future__ import annotations

import io
import json
import re
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("streamlit")

from tests.greenhouse.conftest import shot, wait_until

from cucumbervision.capture.source import example_captures
from cucumbervision_greenhouse.store.records import StopRecord
from cucumbervision_greenhouse.store.repository import open_store
from cucumbervision_greenhouse.store.waiting import WaitingCaptures


class House:
    """A store that a server shows, and what is in it."""

    def __init__(self, folder: Path, start: Callable[..., Any]) -> None:
        self.folder, self._start = folder, start
        self.store = folder / "house.db"
        self.replay = folder / "recorded"
        # As a camera would have recorded them: nothing of them says that they are drawn.
        shutil.copytree(example_captures(), self.replay)
        for path in self.replay.rglob("capture.json"):
            manifest = {**json.loads(path.read_text()), "simulated": False}
            path.write_text(json.dumps(manifest))

    def serve(self) -> Any:
        return self._start(self.folder, "--store", str(self.store), "--replay", str(self.replay))

    def stops(self, name: str) -> list[StopRecord]:
        with open_store(self.store) as store:
            one = next(x for x in store.rounds() if x.name == name)
            return store.stops(one.key)

    def wait_for_stops(self, name: str, number: int) -> list[StopRecord]:
        wait_until(lambda: len(self.stops(name)) >= number)
        return self.stops(name)

    def wait_for_kept(self, number: int) -> None:
        """Wait until so many captures are safe: measured, or on disk."""
        waiting = WaitingCaptures(self.store.with_suffix(".waiting"))
        wait_until(lambda: len({x.key for x in waiting.captures()} | self._keys()) >= number)

    def _keys(self) -> set[str]:
        return {stop.key for stop in self.stops("Monday")}


def press(page: Any, times: int) -> None:
    for _ in range(times):
        page.locator("button.take").tap()
        page.wait_for_timeout(400)


def ready(page: Any) -> None:
    page.locator("button.take:enabled").wait_for()
    page.wait_for_function("document.getElementById('color').naturalWidth > 0")


def field(page: Any, label: str) -> Any:
    return page.get_by_label(label, exact=True).first


def test_a_day_from_the_start_page_to_the_pick_list(
    tmp_path: Path, start_server: Callable[..., Any], new_page: Callable[..., Any]
) -> None:
    house = House(tmp_path, start_server)
    address = house.serve()
    tablet = new_page(1280, 800, has_touch=True)
    tablet.goto(address)

    # Start.
    tablet.get_by_role("button", name="New round").tap()
    field(tablet, "Name").fill("Monday")
    field(tablet, "Name").press("Enter")
    tablet.get_by_role("button", name="Start this round").tap()
    tablet.get_by_text("This round has no stops yet.").wait_for()
    shot(tablet, "walk-start")
    tablet.get_by_role("dialog").wait_for(state="hidden")  # nothing lies over the page any more
    tablet.get_by_role("link", name="Capture").last.tap()

    # Capture; a reload in its middle.
    ready(tablet)
    field(tablet, "Row").fill("3")
    field(tablet, "Row").press("Tab")
    press(tablet, 2)
    house.wait_for_kept(2)
    tablet.reload()
    ready(tablet)
    assert field(tablet, "Row").input_value() == "3"
    assert float(field(tablet, "Next stop at [m]").input_value()) == pytest.approx(0.8)

    # Two browsers at once.
    phone = new_page(390, 844, has_touch=True, is_mobile=True)
    phone.goto(f"{address}/capture")
    ready(phone)
    press(phone, 1)
    press(tablet, 1)
    found = house.wait_for_stops("Monday", 4)
    assert sorted(stop.step or 0 for stop in found) == [1, 2, 3, 4]
    assert {stop.row for stop in found} == {"3"}
    # However near each other the two were pressed, no two stops are at one place.
    assert len({(stop.side, stop.position_m) for stop in found}) == 4
    for page in (tablet, phone):  # each sees the other's stops
        page.locator("#where").get_by_text("Stop 4").wait_for()
    shot(phone, "walk-phone")

    # A kill in mid-capture: what was pressed is there when the program starts again.
    tablet.wait_for_timeout(500)
    press(tablet, 3)
    house.wait_for_kept(7)
    phone.goto(f"{address}/results")
    phone.get_by_text("tap one to open it").wait_for()
    address.process.kill()
    address.process.wait()
    phone.get_by_test_id("stDialog").wait_for()  # Streamlit says that the connection is lost
    address = house.serve()
    tablet.goto(f"{address}/capture")
    found = house.wait_for_stops("Monday", 7)
    assert sorted(stop.step or 0 for stop in found) == [1, 2, 3, 4, 5, 6, 7]
    tablet.locator("#where").get_by_text("Stop 7: row 3", exact=False).wait_for()
    shot(tablet, "walk-capture")

    # Count: the least certain fruit is one, and that is undone.
    tablet.goto(f"{address}/map")
    tablet.get_by_text("true size").wait_for()
    shot(tablet, "walk-map")
    tablet.get_by_role("link", name="Show the least certain").tap()
    accept = tablet.get_by_role("button", name=re.compile(r"^Accept( Shortcut A)?$"))
    accept.tap()
    tablet.get_by_role("button", name="Undo").first.tap()
    accept.wait_for()

    # Pick: a tap on the tablet stands on the phone too.
    tablet.goto(address)
    tablet.locator(".fruit button").first.wait_for()
    tablet.locator(".fruit button").first.tap()
    tablet.get_by_text(re.compile(r"^1 of \d+ picked · 1 of \d+ in all rows$")).wait_for()
    shot(tablet, "walk-pick")
    phone.goto(address)
    phone.locator('.fruit button[aria-pressed="true"]').first.wait_for()
    shot(phone, "walk-phone-pick")
    with open_store(house.store) as store:
        one = next(x for x in store.rounds() if x.name == "Monday")
        assert len(store.picked(one.key)) == 1
    # What the program says where it was started: its address, twice.
    printed = (house.folder / "server.log").read_text().splitlines()
    assert [line for line in printed if "(Ctrl-C ends)" not in line] == []

    # Export: every file is opened.
    tablet.goto(f"{address}/results")
    tablet.get_by_text("Files of this round").tap()
    for name in ("Parquet", "JSON"):
        tablet.get_by_test_id("stButtonGroup").get_by_text(name, exact=True).tap()
        tablet.get_by_role("button", name=name, exact=True, pressed=True).wait_for()
    tablet.locator('a.load[href*="json"]').wait_for()
    with tablet.expect_download() as loading:
        tablet.get_by_role("link", name="Download").tap()
    packed = tmp_path / "round.zip"
    loading.value.save_as(packed)
    open_exports(packed, tablet, fruit_of(house))


def fruit_of(house: House) -> int:
    with open_store(house.store) as store:
        one = next(x for x in store.rounds() if x.name == "Monday")
        return sum(view.best for view in store.detections(one.key))


def open_exports(packed: Path, page: Any, fruit: int) -> None:
    openpyxl, parquet = pytest.importorskip("openpyxl"), pytest.importorskip("pyarrow.parquet")
    folder = packed.with_suffix("")
    with zipfile.ZipFile(packed) as archive:
        archive.extractall(folder)
        csv = archive.read("fruit.csv").decode("utf-8-sig")
        table = parquet.read_table(io.BytesIO(archive.read("fruit.parquet")))
    assert len(csv.splitlines()) == fruit + 1
    assert table.num_rows == fruit
    read = json.loads((folder / "round.json").read_text(encoding="utf-8"))
    assert len(read["tables"]["fruit"]) == fruit
    sheet = openpyxl.load_workbook(folder / "round.xlsx")["Fruit"]
    assert sheet.max_row == fruit + 1
    assert [cell.value for cell in sheet[2]][:2] == [1, "3"]
    page.goto((folder / "round.html").as_uri())
    assert page.get_by_text(f"All fruit: {fruit}").count() == 1
    shot(page, "walk-sheet")
