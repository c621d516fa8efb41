"""Every page on a desktop, a tablet and a phone: readable, in reach of a thumb, nothing cut off."""

from __future__ import annotations

import io
import os
import re
import time
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("streamlit")
pytest.importorskip("axe_playwright_python")

from axe_playwright_python.sync_playwright import Axe
from tests.greenhouse.conftest import WALK, copy_house, copy_round, shot

from cucumbervision.capture.source import example_captures
from cucumbervision_greenhouse.store.records import Round, key_of
from cucumbervision_greenhouse.store.repository import open_store

TODAY = key_of("today")
SIZES = {"desktop": (1440, 900), "tablet": (1024, 768), "phone": (390, 844)}
# Each with words that are there once it is drawn.
PAGES = {
    "today": ("/", "Pick list"),
    "capture": ("/capture", "press as fast as you walk"),
    "upload": ("/upload", "Measure these files"),
    "results": ("/results", "tap one to open it"),
    "fruit": ("/results?fruit={fruit}", "Details"),
    "map": ("/map?fruit={fruit}", "true size"),
    "stop": ("/map?stop={stop}", "Delete this stop"),
    "days": ("/days", "Compare with"),
    "forecast": ("/forecast", "if nothing is picked"),
    "accuracy": ("/accuracy", "Measured by hand"),
    "settings": ("/settings", "Networks"),
    "about": ("/about", "Source code"),
}
LEAST_PX = 44
DARK = "rgb(18, 22, 20)"  # #121614
BACKGROUND = """(color) =>
  getComputedStyle(document.querySelector('.stApp') || document.body).backgroundColor === color"""

# What reaches beyond the screen, words that end in '…', and what is too small for a thumb.
LOOK = """(least) => {
  const every = (root) => [...root.querySelectorAll('*')].flatMap(
    (node) => [node, ...(node.shadowRoot ? every(node.shadowRoot) : [])]);
  const words = (node) => `${node.tagName.toLowerCase()} '${
    (node.getAttribute('aria-label') || node.innerText || node.value || '').trim().slice(0, 40)}'`;
  const found = { cut: [], small: [] };
  if (document.documentElement.scrollWidth > innerWidth) found.cut.push('the page');
  for (const node of every(document.body)) {
    const box = node.getBoundingClientRect(), style = getComputedStyle(node);
    if (box.width < 2 || box.height < 2 || style.visibility === 'hidden') continue;
    if (node.closest('canvas, svg, [data-testid=stDataFrame], .quiet, footer')) continue;
    const own = [...node.childNodes].some((one) => one.nodeType === 3 && one.data.trim());
    const hides = style.overflowX !== 'visible' && style.textOverflow === 'ellipsis';
    const beyond = box.right > innerWidth + 1 || (hides && node.scrollWidth > node.clientWidth + 1);
    if (own && beyond && node.innerText) found.cut.push(words(node));
    const tapped = 'button, a[href], input, select, summary, [role=button], [role=tab]';
    if (!node.matches(tapped) || node.disabled || node.closest('[aria-hidden=true]')) continue;
    // A link in a sentence is text; what is tapped for a field is all that surrounds it.
    if (style.display === 'inline' && node.tagName === 'A') continue;
    const around = 'label, [data-baseweb=select], [data-testid=stSelectbox]';
    const at = (node.closest('[data-testid=stTooltipIcon]') ? node : node.closest(around) || node)
      .getBoundingClientRect();
    if (at.height < least - 0.5 || at.width < least - 0.5)
      found.small.push(`${words(node)} ${Math.round(at.width)} x ${Math.round(at.height)}`);
  }
  return found;
}"""


@pytest.fixture(scope="module")
def address(
    made: Path, tmp_path_factory: pytest.TempPathFactory, start_server: Callable[..., str]
) -> tuple[str, dict[str, str]]:
    """A server with rounds of yesterday and today, and what the addresses of its pages name."""
    folder = tmp_path_factory.mktemp("sizes")
    path = copy_house(made, folder)
    with open_store(path) as store:
        now_s, taken_s = time.time(), store.stops(WALK.key)[0].taken_s
        for key, begun_s in ((key_of("yesterday"), now_s - 86400), (TODAY, now_s)):
            begun = Round(key, "morning", "house 1", begun_s, "long-cucumber")
            copy_round(store, begun, begun_s - taken_s)
        fruit = next(view for view in store.detections(TODAY) if view.length_m)
    server = start_server(folder, "--store", str(path), "--replay", str(example_captures()))
    return server, {"fruit": fruit.key, "stop": fruit.stop_key}


def test_back_and_reload_come_to_the_same_place(
    address: tuple[str, dict[str, str]], new_page: Callable[..., Any]
) -> None:
    page = new_page(*SIZES["phone"], has_touch=True)
    listed, picture = page.locator(".fruit button").first, page.locator("svg.view")
    page.goto(f"{address[0]}/?round={TODAY}")
    page.get_by_text("Pick list").first.wait_for()
    page.wait_for_url("**row=demo**")
    page.goto(f"{address[0]}/results?round={TODAY}")
    listed.tap()
    picture.wait_for()
    assert "fruit=" in page.url
    # At once, within the first screen.
    box = picture.bounding_box()
    assert box["y"] + box["height"] < SIZES["phone"][1]
    page.reload()
    picture.wait_for()
    page.locator(".st-key-nav a").filter(has_text="Row map").click()
    page.get_by_text("true size").wait_for()
    page.go_back()
    picture.wait_for()
    page.go_back()
    listed.wait_for()
    page.go_forward()
    picture.wait_for()
    page.context.close()


def test_a_bar_at_the_bottom_leads_on_and_the_list_is_beside_its_fruit_where_there_is_room(
    address: tuple[str, dict[str, str]], new_page: Callable[..., Any]
) -> None:
    page, desk = new_page(*SIZES["phone"], has_touch=True), new_page(*SIZES["desktop"])
    for one in (page, desk):
        one.goto(f"{address[0]}/results?round={TODAY}")
        one.locator(".fruit button").first.click()
        one.locator("svg.view").wait_for()
    assert desk.locator(".fruit button[aria-current]").count() == 1
    desk.locator(".fruit button:not([aria-current])").last.click()
    desk.locator(".fruit button:last-child[aria-current]").wait_for()
    page.get_by_role("button", name="More").tap()
    page.get_by_role("link", name="Forecast").last.tap()
    page.get_by_text("if nothing is picked").first.wait_for()


def test_a_keyboard_is_four_stops_from_the_list(
    address: tuple[str, dict[str, str]], new_page: Callable[..., Any]
) -> None:
    page = new_page(*SIZES["desktop"])
    page.goto(f"{address[0]}/?round={TODAY}")
    first = page.locator(".fruit button").first
    first.wait_for()
    for _ in range(4):  # Streamlit has a link of its own, and its menu
        page.keyboard.press("Tab")
        if page.evaluate("document.activeElement.className") == "skip":
            break
    page.keyboard.press("Enter")
    page.keyboard.press("Space")
    page.locator('.fruit button[aria-pressed="true"]').first.wait_for()
    # The way there works a second time.
    page.locator(".skip").focus()
    page.keyboard.press("Enter")
    page.keyboard.press("Space")
    # The first list is of the fruit that are ready; one of those to look at may follow.
    page.get_by_text(re.compile(r"^0 of \d+ picked")).first.wait_for()


def test_fruit_are_reviewed_by_keys(
    address: tuple[str, dict[str, str]], new_page: Callable[..., Any]
) -> None:
    page = new_page(*SIZES["desktop"])
    page.goto(f"{address[0]}/results?round={TODAY}")
    page.locator(".fruit button").first.click()

    def button(key: str) -> Any:
        return page.locator(f"[class*='st-key-{key}_'] button")

    def press(key: str) -> None:
        # A key is for what is shown: nothing is drawn any more.
        page.locator("[data-test-script-state=notRunning]").wait_for()
        page.keyboard.press(key)

    button("accepted").wait_for()
    assert button("accepted").locator("kbd").inner_text() == "A"
    first = page.url
    press("a")  # and the next fruit is shown
    page.wait_for_url(lambda url: "fruit=" in url and url != first)
    second, shown = page.url, page.url.split("fruit=")[1].split("&")[0]
    page.locator(f".st-key-rejected_{shown} button").wait_for()
    press("x")
    page.wait_for_url(lambda url: "fruit=" in url and url != second)
    press("z")
    page.get_by_text("Taken back: not a fruit").wait_for()
    press("z")
    page.get_by_text("Taken back: accepted").wait_for()
    page.goto(first)
    button("accepted").wait_for()
    press("Escape")
    page.wait_for_url(lambda url: "fruit=" not in url)  # the list is beside the fruit as well
    page.context.close()


def middle(place: Any) -> tuple[float, float]:
    box = place.bounding_box()
    return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2


def test_two_fingers_enlarge_the_row_and_a_tap_beside_a_fruit_opens_it(
    address: tuple[str, dict[str, str]], new_page: Callable[..., Any]
) -> None:
    page = new_page(*SIZES["phone"], has_touch=True)
    page.goto(f"{address[0]}/map?round={TODAY}")
    drawn, strip = page.locator(".strip svg.row").first, page.locator(".strip").first
    drawn.locator("a").first.wait_for()
    touch = page.context.new_cdp_session(page)

    def fingers(kind: str, *places: tuple[float, float]) -> None:
        points = [{"x": x, "y": y, "id": number} for number, (x, y) in enumerate(places)]
        touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    before, (x, y) = drawn.bounding_box()["width"], middle(strip)
    fingers("touchStart", (x - 30, y), (x + 30, y))
    for apart in (40, 50, 60):
        fingers("touchMove", (x - apart, y), (x + apart, y))
    fingers("touchEnd")
    assert drawn.bounding_box()["width"] == pytest.approx(2 * before, rel=0.1)
    drawn.locator("a .body").first.scroll_into_view_if_needed()
    fruit = drawn.locator("a .body").first.bounding_box()
    page.touchscreen.tap(fruit["x"] - 15, fruit["y"] + fruit["height"] / 2)
    page.get_by_role("button", name="All fruit").wait_for()
    assert "/results?" in page.url


@pytest.mark.parametrize("name", PAGES)
def test_a_page_is_for_everybody(
    address: tuple[str, dict[str, str]], new_page: Callable[..., Any], name: str
) -> None:
    """Drawn on a phone, turned to a tablet and a desktop: what is cut, small or hard to read."""
    server, named = address
    path, words = PAGES[name]
    page, said, faults = new_page(*SIZES["phone"], has_touch=True), list[str](), list[str]()
    page.on("console", lambda line: said.append(line.text))
    page.on("pageerror", lambda error: said.append(str(error)))
    query = "&" if "?" in path else "?"
    page.goto(f"{server}{path.format(**named)}{query}round={TODAY}")
    page.get_by_text(words).first.wait_for()
    if name == "capture":  # with a stop, its picture and its fruit
        page.locator("button.take:enabled").click()
        page.locator("#where").get_by_text("saved").wait_for()
        page.locator("svg.view").first.wait_for()
        page.locator("#measured").get_by_text("cm").wait_for()
    page.locator('[data-testid="stSkeleton"]').first.wait_for(state="hidden")
    for size, theme in (("phone", "dark"), ("tablet", "light"), ("desktop", "light")):
        width, height = SIZES[size]
        page.set_viewport_size({"width": width, "height": height})
        page.emulate_media(color_scheme=theme)
        background = DARK if theme == "dark" else "rgb(255, 255, 255)"
        page.wait_for_function(BACKGROUND, arg=background)
        page.wait_for_timeout(1500)
        assert page.locator("h1").count() == 1
        if name == "capture":
            box = page.locator("#measured").bounding_box()
            assert box["y"] + box["height"] < height
        seen = page.evaluate(LOOK, LEAST_PX)
        faults += [f"{size}: {fault} {what}" for fault in seen for what in seen[fault]]
        if size != "tablet":
            faults += [
                f"{theme} {rule['id']}: {node['target']} {node['html'][:200]}"
                for rule in Axe().run(page).response["violations"]
                for node in rule["nodes"]
            ]
        if os.environ.get("CUCUMBERVISION_ARTEFACTS"):
            # Streamlit's pages scroll within: as high as all that is on them.
            within = "(document.querySelector('.stMain') || document.body).scrollHeight"
            page.set_viewport_size({"width": width, "height": max(page.evaluate(within), height)})
            shot(page, f"{name}-{size}")
    page.context.close()
    assert faults == []
    # Chromium says so of a line that the page closes for another round's before it is open.
    # Streamlit looks for its server below the address of a page first.
    early = ("WebSocket is closed before the connection is established", "404 (Not Found)")
    assert [line for line in said if not any(words in line for words in early)] == []


NAMED = key_of("named")
# What Markdown, Streamlit and browsers make links, pictures, icons, signs and formulas of.
NAME = (
    "![x](http://evil.test/p) HTTPS://evil.test/q www.evil.test me@evil.test :tada: "
    ":material/delete: :red[x] -> <-> -- >= $a$ <b> *c* 1. `d`"
)
SHOWN = ("today", "capture", "results", "map", "stop")  # where the row is read as text
TEXT = """() => {
  const every = (root) => [...root.querySelectorAll('*')].flatMap(
    (node) => [node, ...(node.shadowRoot ? every(node.shadowRoot) : [])]);
  return every(document).map((node) => node.value ?? node.innerText ?? '').join('\\n');
}"""


@pytest.fixture(scope="module")
def named_address(
    made: Path, tmp_path_factory: pytest.TempPathFactory, start_server: Callable[..., str]
) -> tuple[str, dict[str, str]]:
    """A server with a round of today in which all names are odd; a fruit and a stop of it."""
    folder = tmp_path_factory.mktemp("names")
    path = copy_house(made, folder)
    with open_store(path) as store:
        named = Round(NAMED, NAME, NAME, profile="long-cucumber")
        later_s = named.started_s - store.stops(WALK.key)[0].taken_s
        copy_round(store, named, later_s, row=NAME, note=NAME)
        fruit = next(view for view in store.detections(NAMED) if view.length_m)
    server = start_server(folder, "--store", str(path), "--replay", str(example_captures()))
    return server, {"fruit": fruit.key, "stop": fruit.stop_key}


def look(page: Any, name: str) -> str:
    """Return what the page says; no named_address in a name is a link or a picture."""
    shot(page, f"names-{name}")
    assert page.locator('a[href*="evil" i], img[src*="evil" i]').count() == 0
    return str(page.evaluate(TEXT)).replace("\u2060", "").replace("\u00a0", " ")


@pytest.mark.parametrize("name", [x for x in PAGES if x not in ("accuracy", "settings", "about")])
def test_names_are_text_on_every_page(
    named_address: tuple[str, dict[str, str]], new_page: Callable[..., Any], name: str
) -> None:
    page, hosts = new_page(1280, 1600), set[str]()
    page.on("request", lambda one: hosts.add(one.url.split("/")[2].split(":")[0]))
    path, words = PAGES[name] if name != "days" else ("/days", "Nothing to compare yet")
    query = "&" if "?" in path else "?"
    page.goto(f"{named_address[0]}{path.format(**named_address[1])}{query}round={NAMED}")
    page.get_by_text(words).first.wait_for()
    page.locator('[data-testid="stSkeleton"]').first.wait_for(state="hidden")
    page.wait_for_timeout(1500)
    said = look(page, name)
    assert "\\" not in said
    assert NAME in said if name in SHOWN else "evil" not in said.replace(NAME, "")
    assert hosts <= {"127.0.0.1", ""}


def test_names_are_text_on_the_printed_page(
    named_address: tuple[str, dict[str, str]], new_page: Callable[..., Any], tmp_path: Path
) -> None:
    page, asked = new_page(1000, 1400), list[str]()
    packed = page.request.get(f"{named_address[0]}/api/files/{NAMED}?formats=html").body()
    zipfile.ZipFile(io.BytesIO(packed)).extractall(tmp_path)
    page.on("request", lambda one: asked.append(one.url))
    page.goto((tmp_path / "round.html").as_uri())
    assert NAME in look(page, "print")
    assert {one.split(":")[0] for one in asked} <= {"file", "data"}
