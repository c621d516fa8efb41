"""The dashboard in Chromium: its first page, preview, presses and a tap to a fruit."""

from __future__ import annotations

import os
import re
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cucumbervision.capture.source import example_captures
from cucumbervision_greenhouse.rounds.adding import add_captures
from cucumbervision_greenhouse.settings import Settings, settings_file, write_settings
from cucumbervision_greenhouse.store.records import Round, key_of
from cucumbervision_greenhouse.store.repository import open_store
from speeds.timing import GIVEN, Figure

TODAY = key_of("today")
LOOK_MS = 10  # between two looks for what a page is to show
PATIENCE_S = 60.0


class Visit:
    """A page of Chromium on a server of its own; `first_s` is from its start to its first page."""

    def __init__(self, page: Any, address: str, begun_s: float, shown: str) -> None:
        self.page, self.address = page, address
        self.open("/", shown)
        self.first_s = time.perf_counter() - begun_s

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

    def pictures_a_second(self, wait_s: float) -> float:
        """Return how many pictures the preview sends while nobody acts."""
        times_s: list[float] = []

        def count(response: Any) -> None:
            if "/api/preview" in response.url and response.headers.get("content-length") != "0":
                times_s.append(time.perf_counter())

        self.page.on("response", count)
        self.open("/capture", "button.take:enabled")
        self.page.wait_for_timeout(4000)
        times_s.clear()
        self.page.wait_for_timeout(1000 * wait_s)
        return len(times_s) / wait_s


def compiled(folder: Path) -> dict[str, str]:
    """Return an environment in which all that servers import is compiled, as where it is installed.

    Python keeps it in a folder.
    """
    environment = {**os.environ, "PYTHONPYCACHEPREFIX": str(folder), "CUCUMBERVISION_LOGIN": "none"}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    code = "import cucumbervision.cli.app, cucumbervision_greenhouse.pages.app"
    quiet = subprocess.DEVNULL
    subprocess.run([sys.executable, "-c", code], check=True, env=environment, stderr=quiet)
    return environment


@contextmanager
def served(
    browser: Any, store: Path, replay: Path, environment: dict[str, str], shown: str = "h1"
) -> Iterator[Visit]:
    """Serve a dashboard on the loopback, and open a page on it."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    code, quiet = "from cucumbervision.cli.app import main; main()", subprocess.DEVNULL
    words = ["--no-browser", "--port", str(port), "--store", str(store), "--replay", str(replay)]
    command, address = [sys.executable, "-c", code, "dashboard", *words], f"http://127.0.0.1:{port}"
    page = browser.new_page(viewport={"width": 1280, "height": 800}, has_touch=True)
    page.set_default_timeout(1000 * PATIENCE_S)
    begun_s = time.perf_counter()
    with subprocess.Popen(command, stdout=quiet, stderr=quiet, env=environment) as server:
        try:
            while server.poll() is None:
                try:
                    page.request.get(f"{address}/_stcore/health")
                    break
                except Exception:  # it does not listen yet
                    time.sleep(0.05)
            yield Visit(page, address, begun_s, shown)
            page.context.close()
        finally:
            server.terminate()


def dashboard(quick: bool) -> Iterator[Figure]:
    """Time a walk, and the pages of a house with a round of 320 stops."""
    from playwright.sync_api import sync_playwright
    from tests.conftest import FLAGS, record
    from tests.greenhouse.conftest import WALK

    # A server that was stopped may still write into the folder.
    with (
        tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder,
        sync_playwright() as web,
    ):
        path = shutil.which("chromium") or shutil.which("chromium-browser")
        browser = web.chromium.launch(executable_path=path, args=list(FLAGS))
        environment, walk = compiled(Path(folder) / "compiled"), Path(folder) / "walk.db"
        write_settings(Settings(fruit_from="models"), settings_file(str(walk)))
        with open_store(walk) as store:
            store.save_round(WALK)
        recording = record(walk.with_suffix(".db3"), 150, scene=passing, enlarged=4)
        with served(browser, walk, recording, environment) as visit:
            yield Figure("first page after a start, no stop yet", visit.first_s, "s", "<= 2")
            words = "preview of 1280x720 while it moves, pictures a second"
            yield Figure(words, visit.pictures_a_second(5.0), "/s", ">= 10")
        house = filled_house(Path(folder) / "house.db")
        with served(browser, house, example_captures(), environment, "text=Pick list") as visit:
            yield Figure("first page after a start, 320 stops", visit.first_s, "s", "<= 2")
            yield from tap_figures(visit, 3 if quick else 8)


def passing(index: int) -> tuple[NDArray[np.uint16], NDArray[np.uint8]]:
    """Draw a frame of a walk: a wall of leaves passes by, 24 pixels of 1280 a frame."""
    rng = np.random.default_rng(3)
    leaves = rng.integers(20, 200, (18, 32, 3), np.uint8)
    color = cv2.resize(leaves, (320, 180), interpolation=cv2.INTER_CUBIC)
    depth = cv2.resize(leaves[..., 0].astype(np.uint16) + 450, (320, 180))
    shift = -6 * index % 320
    return np.roll(depth, shift, axis=1), np.roll(color, shift, axis=1)


def filled_house(path: Path) -> Path:
    """Fill a house: a round of today, and one of 320 stops."""
    from tests.greenhouse.conftest import WALK, long_round

    write_settings(Settings(fruit_from="models"), settings_file(str(path)))
    now_s = time.time()
    with open_store(path) as store:
        store.save_round(WALK)
        add_captures(store, WALK.key, [example_captures()], GIVEN)
        stops = [store.stop(stop.key) for stop in store.stops(WALK.key)]
        long_round(store, stops[0], 320)
        store.save_round(Round(TODAY, "morning", WALK.house, now_s, WALK.profile))
        for number, stop in enumerate(stops):
            moved = replace(stop, key=key_of(TODAY, number), round_key=TODAY)
            store.save_stop(replace(moved, taken_s=now_s + number))
    return path


def tap_figures(visit: Visit, rounds: int) -> Iterator[Figure]:
    """Time presses until their result, and a tap until a fruit's picture is shown."""
    page = visit.page
    page.get_by_text("Loading the networks").first.wait_for(state="hidden")
    visit.open(f"/capture?round={TODAY}", "button.take:enabled")
    page.wait_for_timeout(2000)
    words, taken_s = page.locator("#where").inner_text(), []
    stops = int(re.findall(r"Stop (\d+)", f"{words} Stop 0")[0])
    for number in range(stops + 1, stops + rounds + 2):
        shown = f"#where:has-text('Stop {number}:')"
        taken_s.append(visit.seconds(page.locator("button.take").tap, shown))
        page.wait_for_timeout(2000)
    yield Figure("a press to its result", median(taken_s[1:]), "s", "<= 0.5")
    visit.open(f"/results?round={TODAY}", ".fruit button")
    fruit_s = visit.seconds(page.locator(".fruit button").first.click, "svg.view polygon")
    yield Figure("tap to screen: fruit", fruit_s, "s", "<= 0.4")
