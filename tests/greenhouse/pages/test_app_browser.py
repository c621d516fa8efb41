"""A real Chromium walks the pages of a real server on a fresh machine.

Each test stands by itself: any of them may be the first that the server sees.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("streamlit")

from tests.greenhouse.conftest import shot, wait_until

from cucumbervision.capture.source import example_captures
from cucumbervision_greenhouse.store.repository import open_store

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

    wait_until(all_written)


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
