"""Pages of the dashboard in Chromium: presses, taps and pages, as ratios measured in one run.

`speed.py dashboard` prints them. The server and the browser have the same cores.
"""

from __future__ import annotations

import re
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any

import cv2
import numpy as np
from figures import Figure
from numpy.typing import NDArray

from cucumbervision.capture.readers import open_source
from cucumbervision.capture.source import example_captures
from cucumbervision.pipeline.measurer import Measurer
from cucumbervision.pipeline.options import MeasureOptions
from cucumbervision_greenhouse.backend.settings import Settings, settings_file, write_settings
from cucumbervision_greenhouse.rounds.adding import add_captures
from cucumbervision_greenhouse.store.records import Round, key_of
from cucumbervision_greenhouse.store.repository import open_store
from cucumbervision_greenhouse.store.waiting import WaitingCaptures, waiting_folder

GIVEN = MeasureOptions(instances="dataset", segmenter="none")
LOOK_MS = 10  # between two looks for what a page is to show
PATIENCE_S = 300.0
ROUNDS = 3
TIME_TO_AIM_S = 1.0  # from the choice of a tool to the tap into the picture
PLAIN = """
import streamlit as st

def first(): st.title("First")
def second(): st.title("Second")

st.navigation([st.Page(first, default=True), st.Page(second)]).run()
"""
"""A page of Streamlit with nothing on it, and another one to go to."""


class Visit:
    """A page of Chromium on a dashboard of its own."""

    def __init__(self, store: Path, page: Any, address: str, begun_s: float) -> None:
        self.store, self.page, self.address, self._begun_s = store, page, address, begun_s

    def first(self, shown: str) -> float:
        """Open the first page, and return how long that took from the start of the server."""
        self.open("/", shown)
        return time.perf_counter() - self._begun_s

    def seconds(self, act: Callable[[], object], shown: str) -> float:
        """Return the time from an act to the moment at which an element is seen.

        Playwright's own `wait_for` looks after 0.27, 0.77 and 1.27 s, and not between: a page
        that shows after 0.3 s would count as 0.77 s.
        """
        begun = time.perf_counter()
        act()
        element = self.page.locator(shown).first
        while not element.is_visible():
            if time.perf_counter() - begun > PATIENCE_S:
                raise SystemExit(f"{shown} is not shown on {self.page.url}")
            self.page.wait_for_timeout(LOOK_MS)
        return time.perf_counter() - begun

    def open(self, path: str, shown: str) -> float:
        """Open an address, and return how long that takes."""
        return self.seconds(lambda: self.page.goto(f"{self.address}{path}"), shown)

    def kept(self) -> int:
        """Return how many captures are stops, or wait to be measured."""
        waiting = WaitingCaptures(waiting_folder(str(self.store)))
        keys = {waits.key for waits in (*waiting.captures(), *waiting.set_aside())}
        with open_store(self.store) as store:
            keys |= {stop.key for walk in store.rounds() for stop in store.stops(walk.key)}
        return len(keys)

    def received(self, wait_s: float) -> tuple[int, int]:
        """Return how many pictures, and bytes of them, the preview sends while nobody acts."""
        sizes: list[int] = []
        self.page.on(
            "websocket",
            lambda line: (
                "preview" in line.url
                and line.on("framereceived", lambda frame: sizes.append(len(frame)))
            ),
        )
        self.open("/capture", "button.take:enabled")
        self.page.wait_for_timeout(4000)
        sizes.clear()
        self.page.wait_for_timeout(1000 * wait_s)
        return len(sizes), sum(sizes)


@contextmanager
def chromium(command: Sequence[str], port: int, store: Path) -> Iterator[Visit]:
    """Start a server on the loopback, and give a page of Chromium that opens it."""
    from playwright.sync_api import sync_playwright
    from tests.greenhouse.conftest import FLAGS

    quiet, address = subprocess.DEVNULL, f"http://127.0.0.1:{port}"
    with sync_playwright() as web:
        path = shutil.which("chromium") or shutil.which("chromium-browser")
        browser = web.chromium.launch(executable_path=path, args=list(FLAGS))
        page = browser.new_page(viewport={"width": 1280, "height": 800}, has_touch=True)
        page.set_default_timeout(1000 * PATIENCE_S)
        begun_s = time.perf_counter()
        with subprocess.Popen(command, stdout=quiet, stderr=quiet) as server:
            try:
                while server.poll() is None:
                    try:
                        page.request.get(f"{address}/_stcore/health")
                        break
                    except Exception:  # it does not listen yet
                        time.sleep(0.05)
                yield Visit(store, page, address, begun_s)
            finally:
                server.terminate()


def free_port() -> int:
    """Return a port that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def visit(store: Path, replay: Path) -> Iterator[Visit]:
    """Serve a dashboard, and open a page of Chromium on it."""
    code, port = "from cucumbervision.cli.app import main; main()", free_port()
    words = ["--no-browser", "--port", str(port), "--store", str(store), "--replay", str(replay)]
    with chromium([sys.executable, "-c", code, "dashboard", *words], port, store) as seen:
        yield seen


def passing(index: int) -> tuple[NDArray[np.uint16], NDArray[np.uint8]]:
    """Draw a frame of a walk: a wall of leaves passes by, 24 pixels of 1280 a frame."""
    rng = np.random.default_rng(3)
    leaves = rng.integers(20, 200, (18, 32, 3), np.uint8)
    color = cv2.resize(leaves, (320, 180), interpolation=cv2.INTER_CUBIC)
    depth = cv2.resize(leaves[..., 0].astype(np.uint16) + 450, (320, 180))
    shift = -6 * index % 320
    return np.roll(depth, shift, axis=1), np.roll(color, shift, axis=1)


def plain_pages() -> tuple[float, float, float]:
    """Return how long Streamlit's plain pages take: after a start, cold, and within the app."""
    with tempfile.TemporaryDirectory() as folder:
        script, port = Path(folder) / "plain.py", free_port()
        script.write_text(PLAIN, encoding="utf-8")
        options = ("--server.headless=true", f"--server.port={port}", "--server.address=127.0.0.1")
        command = [sys.executable, "-m", "streamlit", "run", str(script), *options]
        with chromium(command, port, script) as seen:
            first_s = seen.first("h1:has-text('First')")
            cold, within = [], []
            for _ in range(ROUNDS):
                cold.append(seen.open("/second", "h1:has-text('Second')"))
                way = seen.page.get_by_role("link", name="first")
                within.append(seen.seconds(way.click, "h1:has-text('First')"))
    return first_s, median(cold), median(within)


def result_s() -> float:
    """Return how long all networks and methods take for a capture in memory, as `speed.py` does."""
    captures = [replace(ref.load(), masks=()) for ref in open_source(example_captures())]
    measurer = Measurer(Settings(fruit_from="models").options)
    for capture in captures:
        measurer.measure(capture)
    begun_s = time.perf_counter()
    for capture in captures:
        measurer.measure(capture)
    return (time.perf_counter() - begun_s) / len(captures)


OUTLINE, MEASURED = "svg.view polygon[stroke-dasharray]", "text=Saved: measured with this outline"


def presses_and_taps(seen: Visit, round_key: str) -> dict[str, float]:
    """Return the times of presses, and of outlines drawn anew by a tap, seconds."""
    page = seen.page
    page.get_by_text("Loading the networks").first.wait_for(state="hidden")
    taken = []
    for number in range(1, ROUNDS + 2):
        shown = f"#where:has-text('Stop {number}:')"
        taken.append(seen.seconds(page.locator("button.take").tap, shown))
        page.wait_for_timeout(2000)
    seen.open(f"/results?round={round_key}", ".fruit button")
    fruit_s = seen.seconds(page.locator(".fruit button").first.click, "svg.view polygon")
    outlines, redrawn = [], []
    for _ in range(ROUNDS):
        page.get_by_role("button", name="Redraw by tap").click()
        page.wait_for_timeout(1000 * TIME_TO_AIM_S)
        begun_s = time.perf_counter()
        outlines.append(seen.seconds(page.locator("svg.view").click, OUTLINE))
        seen.seconds(lambda: None, MEASURED)
        redrawn.append(time.perf_counter() - begun_s)
        page.locator("[class*='st-key-chevron_right'] button").click()
        page.get_by_text("Saved: measured with this outline").wait_for(state="hidden")
        page.locator("svg.view polygon").first.wait_for()
    return {
        "press": median(taken[1:]),
        "fruit": fruit_s,
        "outline, first": outlines[0],
        "outline": median(outlines[1:]),
        "redrawn": median(redrawn),
    }


SHOWN = {
    "results": ".fruit button",
    "map": "text=One mark per fruit",
    "forecast": "text=fruit too small to be detected today",
    "accuracy": "text=Save these lengths",
}


def pages(seen: Visit, round_key: str) -> tuple[list[float], list[float]]:
    """Return how long each page of a round takes: opened anew, and from another page."""
    cold = [seen.open(f"/{name}?round={round_key}", shown) for name, shown in SHOWN.items()]
    within = []
    for name, shown in SHOWN.items():
        way = seen.page.locator(".st-key-nav a").filter(has_text=re.compile(name, re.I))
        within.append(seen.seconds(way.click, shown))
        seen.page.wait_for_timeout(2000)
    return cold, within


def axe_findings(seen: Visit) -> int:
    """Return how many elements of all pages break a rule of axe: three sizes, two themes."""
    from axe_playwright_python.sync_playwright import Axe
    from tests.greenhouse.dashboard.test_app_sizes import PAGES, SIZES

    with open_store(seen.store) as store:
        newest = max(store.rounds(), key=lambda walk: walk.record.started_s).key
        fruit = next(view for view in store.detections(newest) if view.record.length_m)
    findings = 0
    for path, words in PAGES.values():
        path = path.format(fruit=fruit.key, stop=fruit.stop_key)
        for width, height in SIZES.values():
            seen.page.set_viewport_size({"width": width, "height": height})
            seen.page.goto(f"{seen.address}{path}{'&' if '?' in path else '?'}round={newest}")
            seen.page.get_by_text(words).first.wait_for()
            for theme in ("light", "dark"):
                seen.page.emulate_media(color_scheme=theme)
                seen.page.wait_for_timeout(1500)
                rules = Axe().run(seen.page).response["violations"]
                findings += sum(len(rule["nodes"]) for rule in rules)
    return findings


def dashboard(quick: bool) -> list[Figure]:
    """Time presses, preview and pages in Chromium, beside a capture and a plain page."""
    from tests.conftest import record
    from tests.greenhouse.conftest import LONG, WALK, long_round

    presses = 20 if quick else 200
    plain_first_s, plain_cold_s, plain_within_s = plain_pages()
    capture_s = result_s()
    with tempfile.TemporaryDirectory() as tmp:
        house, walk = Path(tmp) / "house.db", Path(tmp) / "walk.db"
        write_settings(Settings(fruit_from="models"), settings_file(str(house)))
        with open_store(walk) as store:
            store.save_round(WALK)
        with visit(walk, record(Path(tmp) / "walk.db3", 150, scene=passing, enlarged=4)) as seen:
            first_s = seen.first("h1")
            moving, _ = seen.received(5.0)
            for _ in range(presses):
                seen.page.locator("button.take").tap()
                seen.page.wait_for_timeout(100)
            seen.page.locator("#presses .waiting").first.wait_for(state="hidden")
            kept = seen.kept()
        with open_store(house) as store:
            store.save_round(WALK)
            add_captures(store, WALK.key, [example_captures()], GIVEN)
            long_round(store, store.stop(store.stops(WALK.key)[0].key), 320)
            store.save_round(Round(key_of("taps"), "taps", "", time.time(), "long-cucumber"))
        with visit(house, example_captures()) as seen:
            _, still = seen.received(5.0)
            taps = presses_and_taps(seen, WALK.key)
            cold, within = pages(seen, LONG.key)
            findings = axe_findings(seen)
    return [
        Figure("presses that are one stop each", 100 * kept / presses, "%", ">= 100"),
        Figure("preview of 1280x720 while it moves, pictures a second", moving / 5, "/s", ">= 10"),
        Figure("preview while still", still / 5e3, "kB/s", "<= 1"),
        Figure("a capture, all networks, in memory", capture_s, "s"),
        Figure("a press to its result", taps["press"], "s", "<= 0.5"),
        Figure("a press to its result, times a capture", taps["press"] / capture_s, "x"),
        Figure("tap to screen: fruit", taps["fruit"], "s", "<= 0.4"),
        Figure("tap to its outline, first of a picture", taps["outline, first"] / capture_s, "x"),
        Figure("tap to its outline", taps["outline"] / capture_s, "x", "<= 0.2"),
        Figure("tap to the new length, saved", taps["redrawn"] / taps["press"], "of a press"),
        Figure("first page after a start", first_s, "s", "<= 2"),
        Figure("first page, times a plain one", first_s / plain_first_s, "x"),
        Figure(
            "pages of 320 stops, cold, times a plain one: median",
            median(cold) / plain_cold_s,
            "x",
            "<= 1.3",
        ),
        Figure("the same: slowest", max(cold) / plain_cold_s, "x"),
        Figure(
            "pages of 320 stops, from another page, times a plain one: median",
            median(within) / plain_within_s,
            "x",
            "<= 1.3",
        ),
        Figure("the same: slowest", max(within) / plain_within_s, "x"),
        Figure("axe, all rules, all pages, three sizes, two themes", findings, "", "<= 0"),
    ]
