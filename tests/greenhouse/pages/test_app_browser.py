"""A real Chromium walks the pages of a real server on a fresh machine.

Each test stands by itself: any of them may be the first that the server sees.
"""

from __future__ import annotations

import io
import json
import re
import shutil
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("streamlit")

from tests.greenhouse.conftest import shot, wait_until

from cucumbervision.capture.source import example_captures
from cucumbervision_greenhouse.store.records import StopRecord
from cucumbervision_greenhouse.store.repository import open_store
from cucumbervision_greenhouse.store.waiting import WaitingCaptures

REDRAWS = 8  # what each of them would leave behind is found by the second


@dataclass
class Dashboard:
    """A browser's page on a running server."""

    page: Any
    address: str
    store: Path
    hosts: set[str]
    faults: list[str]

    def go(self, name: str) -> None:
        self.page.locator(".st-key-nav a").filter(has_text=name).click()
        self.quiet()

    def quiet(self) -> None:
        """Wait until nothing is being drawn any more."""
        still = 0
        for _ in range(1500):
            drawing = self.page.locator('[data-testid="stSkeleton"]').count()
            still = 0 if drawing else still + 1
            if still == 3:
                return
            self.page.wait_for_timeout(200)
        raise AssertionError("the page is still being drawn")


@pytest.fixture(scope="module")
def served(
    tmp_path_factory: pytest.TempPathFactory, start_server: Callable[..., str]
) -> tuple[str, Path]:
    """The address of a server on a fresh machine, and its store."""
    folder = tmp_path_factory.mktemp("browser")
    store, replay = folder / "house.db", example_captures()
    return start_server(folder, "--store", str(store), "--replay", str(replay)), store


@pytest.fixture
def dashboard(served: tuple[str, Path], new_page: Callable[[], Any]) -> Iterator[Dashboard]:
    """The results of the bundled captures; asks that nothing failed, nor left this machine."""
    (address, store), page, hosts, faults = served, new_page(), set[str](), list[str]()
    page.on("request", lambda r: hosts.add(r.url.split("/")[2]) if "//" in r.url else None)
    page.on("pageerror", lambda error: faults.append(str(error)))
    page.goto(f"{address}/results")
    opened = Dashboard(page, address, store, hosts, faults)
    # Eight fruit in the three bundled captures; the page follows while they are being measured.
    shown = page.get_by_test_id("stMetricValue").first
    shown.filter(has_text=re.compile(r"^([89]|[1-9]\d+)$")).wait_for()
    page.get_by_text("tap one to open it").wait_for()
    opened.quiet()
    yield opened
    assert {host.split(":")[0] for host in hosts} == {"127.0.0.1"}
    assert faults == []


def test_a_page_that_was_drawn_anew_for_long_is_as_it_was_and_obeys(dashboard: Dashboard) -> None:
    page = dashboard.page
    page.goto(f"{dashboard.address}/results")  # nothing is measured any more, and no round is named
    metric = page.get_by_test_id("stMetric").filter(has_text="Picked")
    picked = metric.get_by_test_id("stMetricValue")
    before, nodes = int(picked.inner_text()), list[int]()
    with open_store(dashboard.store) as store:
        shown = store.rounds()[0].key
        left = next(x.key for x in store.detections(shown) if x.best and x.picked_s is None)
        for _ in range(REDRAWS // 2):
            for change, number in ((store.pick, before + 1), (store.unpick, before)):
                change([left])
                picked.filter(has_text=re.compile(f"^{number}$")).wait_for()
            dashboard.quiet()
            nodes.append(page.evaluate("document.querySelectorAll('*').length"))
    assert max(nodes[1:]) <= nodes[0]
    page.locator(".fruit button").first.click()
    page.locator("svg.view").wait_for()


def test_what_somebody_else_does_is_shown_and_follows_no_link(dashboard: Dashboard) -> None:
    page = dashboard.page
    links = "[...document.querySelectorAll('.st-key-nav a')]"
    tap = f"name => {links}.find(link => link.innerText.includes(name)).click()"
    with open_store(dashboard.store) as store:
        shown = store.rounds()[0].key
        left = next(x.key for x in store.detections(shown) if x.best and x.picked_s is None)
        for change, name in ((store.pick, "Settings"), (store.unpick, "Results")):
            change([left])
            page.evaluate(tap, name)
            page.get_by_role("heading", name=name, level=1).wait_for()
            dashboard.quiet()
            assert f"/{name.lower()}" in page.url


def test_a_fruit_is_looked_at_measured_and_accepted(dashboard: Dashboard) -> None:
    page = dashboard.page
    page.locator(".fruit button").first.click()
    page.locator("[class*='st-key-accepted_'] button").wait_for()
    picture = page.locator("svg.view")
    picture.wait_for()
    assert picture.locator("polygon").count() == 3  # its own, and those of the other two
    page.get_by_role("button", name="Details", exact=True).click()
    page.get_by_role("button", name="Box", exact=True).click()
    assert picture.locator("polyline").count() == 4  # box and axis, each with a dark edge
    page.get_by_role("button", name="Depth").click()
    page.get_by_role("button", name="Colour", exact=True).click()

    page.get_by_role("button", name="Ruler").click()
    box = picture.bounding_box()
    page.mouse.click(box["x"] + 0.4 * box["width"], box["y"] + 0.45 * box["height"])
    page.mouse.click(box["x"] + 0.6 * box["width"], box["y"] + 0.45 * box["height"])
    page.get_by_text("Ruler:").wait_for()
    shot(page, "dashboard-fruit")

    page.locator("[class*='st-key-accepted_'] button").click()
    page.get_by_role("button", name="Previous", disabled=False).click()  # reviewing went on
    page.get_by_role("button", name="Accepted").wait_for()
    page.get_by_role("tab", name="3D").click()
    scene = page.get_by_test_id("stDeckGlJsonChart").locator("canvas").first
    scene.wait_for()
    dashboard.quiet()
    before = scene.screenshot()
    box = scene.bounding_box()
    page.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 0.5 * box["height"])
    page.mouse.down()
    page.mouse.move(box["x"] + 0.7 * box["width"], box["y"] + 0.6 * box["height"], steps=5)
    page.mouse.up()
    page.wait_for_timeout(1000)
    assert scene.screenshot() != before
    shot(page, "dashboard-cloud")
    page.get_by_role("button", name="All fruit").click()


def by_hand(page: Any, values: list[str], first: int = 0) -> Any:
    """Type a column of lengths as somebody does who types fast; return its fields."""
    fields = page.get_by_label("By hand, fruit")
    fields.nth(7).wait_for()
    fields.nth(first).click()
    for value in values:  # the page is drawn anew after each
        page.keyboard.press("Control+a")
        page.keyboard.type(value)
        page.keyboard.press("Enter")
    return fields


def save_by_hand(dashboard: Dashboard, page: Any, values: list[str]) -> None:
    """Save them, and wait until all of these stand in the file."""
    sure = page.get_by_text("Yes, these lengths are right")
    page.get_by_text(f"{values[-1]} cm by hand").wait_for()  # the page has all of them
    while sure.count() > 1:  # one of before goes
        page.wait_for_timeout(100)
    sure.click()
    page.get_by_role("button", name="Save these lengths", disabled=False).click()
    lines = [f",{float(value):.2f}," for value in values]
    folder = dashboard.store.with_suffix(".truth")

    def all_written() -> bool:
        written = "".join(file.read_text() for file in folder.glob("*.csv"))
        return all(line in written for line in lines)

    wait_until(page, all_written)


def test_lengths_typed_one_after_the_other_are_all_kept(
    dashboard: Dashboard, new_page: Callable[[], Any]
) -> None:
    page = dashboard.page
    dashboard.go("Accuracy")
    second = new_page()  # of somebody who looks at the same fruit
    second.goto(page.url)
    typed = [f"{70 + line}.1" for line in range(7)]
    fields = by_hand(page, typed)
    dashboard.quiet()
    assert [fields.nth(line).input_value() for line in range(7)] == typed
    # The same fruit measured again by the other, who does not see the first length yet.
    second.get_by_label("Again, fruit").first.fill("71.4")
    second.get_by_label("Again, fruit").first.blur()
    save_by_hand(dashboard, page, typed)
    # What is saved by somebody else since does not take it away.
    last = "99.1"
    by_hand(second, [last], first=7)
    save_by_hand(dashboard, second, [*typed, last])
    for one in (page, second):
        one.reload()
        fields = one.get_by_label("By hand, fruit")
        fields.nth(7).wait_for()
        assert [fields.nth(line).input_value() for line in range(8)] == [*typed, last]
        assert one.get_by_label("Again, fruit").first.input_value() == "71.4"
    second.close()
    shot(page, "dashboard-hand")


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

    def wait_for_stops(self, page: Any, name: str, number: int) -> list[StopRecord]:
        wait_until(page, lambda: len(self.stops(name)) >= number)
        return self.stops(name)

    def wait_for_kept(self, page: Any, number: int) -> None:
        """Wait until so many captures are safe: measured, or on disk."""
        waiting = WaitingCaptures(self.store.with_suffix(".waiting"))
        wait_until(page, lambda: len({x.key for x in waiting.captures()} | self._keys()) >= number)

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
    house.wait_for_kept(tablet, 2)
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
    found = house.wait_for_stops(tablet, "Monday", 4)
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
    house.wait_for_kept(tablet, 7)
    phone.goto(f"{address}/results")
    phone.get_by_text("tap one to open it").wait_for()
    address.process.kill()
    address.process.wait()
    phone.get_by_test_id("stDialog").wait_for()  # Streamlit says that the connection is lost
    address = house.serve()
    tablet.goto(f"{address}/capture")
    found = house.wait_for_stops(tablet, "Monday", 7)
    assert sorted(stop.step or 0 for stop in found) == [1, 2, 3, 4, 5, 6, 7]
    tablet.locator("#where").get_by_text("Stop 7: row 3", exact=False).wait_for()
    shot(tablet, "walk-capture")

    # Count: a fruit is one, and that is undone.
    tablet.goto(f"{address}/map")
    tablet.get_by_text("true size").wait_for()
    tablet.goto(f"{address}/results")
    tablet.locator(".fruit button").first.tap()
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
