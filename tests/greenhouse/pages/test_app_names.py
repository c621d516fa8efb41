"""Whatever a row, house, round or stop is called: pages show it as typed, and ask nobody for it."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from tests.greenhouse.conftest import WALK, copy_house, copy_round, shot

pytest.importorskip("streamlit")

from cucumbervision.capture.source import example_captures
from cucumbervision_greenhouse.store.records import Round, key_of
from cucumbervision_greenhouse.store.repository import open_store

NAMED = key_of("named")
# What Markdown, Streamlit and browsers make links, pictures, icons, signs and formulas of.
NAME = (
    "![x](http://evil.test/p) HTTPS://evil.test/q www.evil.test me@evil.test :tada: "
    ":material/delete: :red[x] -> <-> -- >= $a$ <b> *c* 1. `d`"
)
PAGES = {
    "today": ("/", "Pick list"),
    "capture": ("/capture", "press as fast as you walk"),
    "upload": ("/upload", "Measure these files"),
    "results": ("/results", "tap one to open it"),
    "fruit": ("/results?fruit={fruit}", "Details"),
    "map": ("/map?fruit={fruit}", "true size"),
    "stop": ("/map?stop={stop}", "Delete this stop"),
    "days": ("/days", "Nothing to compare yet"),
    "forecast": ("/forecast", "if nothing is picked"),
}
SHOWN = ("today", "capture", "results", "map", "stop")  # where the row is read as text
TEXT = """() => {
  const every = (root) => [...root.querySelectorAll('*')].flatMap(
    (node) => [node, ...(node.shadowRoot ? every(node.shadowRoot) : [])]);
  return every(document).map((node) => node.value ?? node.innerText ?? '').join('\\n');
}"""


@pytest.fixture(scope="module")
def address(
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
    """Return what the page says; no address in a name is a link or a picture."""
    shot(page, f"names-{name}")
    assert page.locator('a[href*="evil" i], img[src*="evil" i]').count() == 0
    return str(page.evaluate(TEXT)).replace("\u2060", "").replace("\u00a0", " ")


@pytest.mark.parametrize("name", PAGES)
def test_names_are_text_on_every_page(
    address: tuple[str, dict[str, str]], new_page: Callable[..., Any], name: str
) -> None:
    page, hosts = new_page(1280, 1600), set[str]()
    page.on("request", lambda one: hosts.add(one.url.split("/")[2].split(":")[0]))
    path, words = PAGES[name]
    query = "&" if "?" in path else "?"
    page.goto(f"{address[0]}{path.format(**address[1])}{query}round={NAMED}")
    page.get_by_text(words).first.wait_for()
    page.locator('[data-testid="stSkeleton"]').first.wait_for(state="hidden")
    page.wait_for_timeout(1500)
    said = look(page, name)
    assert "\\" not in said
    assert NAME in said if name in SHOWN else "evil" not in said.replace(NAME, "")
    assert hosts <= {"127.0.0.1", ""}


def test_names_are_text_on_the_printed_page(
    address: tuple[str, dict[str, str]], new_page: Callable[..., Any], tmp_path: Path
) -> None:
    page, asked = new_page(1000, 1400), list[str]()
    packed = page.request.get(f"{address[0]}/api/files/{NAMED}?formats=html").body()
    zipfile.ZipFile(io.BytesIO(packed)).extractall(tmp_path)
    page.on("request", lambda one: asked.append(one.url))
    page.goto((tmp_path / "round.html").as_uri())
    assert NAME in look(page, "print")
    assert {one.split(":")[0] for one in asked} <= {"file", "data"}
