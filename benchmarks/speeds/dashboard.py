"""The dashboard in Chromium: presses, taps and pages, as ratios measured in one run."""

from __future__ import annotations

import re
import tempfile
import time
from collections.abc import Iterator
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
from cucumbervision.run.measurer import Measurer
from cucumbervision_greenhouse.rounds.adding import add_captures
from cucumbervision_greenhouse.settings import Settings, settings_file, write_settings
from cucumbervision_greenhouse.store.records import Round, key_of
from cucumbervision_greenhouse.store.repository import open_store
from cucumbervision_greenhouse.store.waiting import WaitingCaptures, waiting_folder
from speeds.chromium import Visit, chromium, compiled, dashboard_served, plain_served
from speeds.frames import GIVEN
from speeds.progress import Steps
from speeds.task_taps import task_taps

TODAY, YESTERDAY = key_of("today"), key_of("yesterday")
SIZES = {"desktop": (1440, 900), "tablet": (1024, 768), "phone": (390, 844)}
TIME_TO_AIM_S = 1.0  # from the choice of a tool to the tap into the picture
OUTLINE, MEASURED = "svg.view polygon[stroke-dasharray]", "text=Saved: measured with this outline"
SHOWN = {
    "results": ".fruit button",
    # By its element: a search of the whole page would read the words of every mark each time.
    "map": "[data-testid=stCaptionContainer]:has-text('One mark per fruit')",
    "forecast": "text=fruit too small to be detected today",
    "accuracy": "text=Save these lengths",
}
"""Pages, and what each shows last."""


def dashboard(quick: bool) -> Iterator[Figure]:
    """Time presses, preview, taps and pages beside a capture and a plain page."""
    steps = Steps(
        {
            "a capture in memory": 8,
            "a walk: preview and presses": 30 if quick else 60,
            "a house of 320 stops": 15,
            "pages beside plain ones": 30 if quick else 90,
            "presses, and outlines by tap": 35,
            "taps of the tasks": 30,
            "axe": 30 if quick else 150,
        }
    )
    with (
        # A server that was stopped may still write into it.
        tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder,
        chromium() as browser,
    ):
        environment = compiled(Path(folder) / "compiled")
        steps.begin("a capture in memory")
        capture_s = result_s()
        yield Figure("a capture, all networks, in memory", capture_s, "s")
        steps.begin("a walk: preview and presses")
        yield from walk_figures(
            browser, Path(folder) / "walk.db", 20 if quick else 200, environment
        )
        steps.begin("a house of 320 stops")
        store = filled_house(Path(folder) / "house.db")
        with (
            plain_served(browser, Path(folder), environment) as plain,
            dashboard_served(
                browser, store, example_captures(), environment, "text=Pick list"
            ) as seen,
        ):
            steps.begin("pages beside plain ones")
            yield from page_figures(seen, plain, 1 if quick else 5)
            steps.begin("presses, and outlines by tap")
            yield from tap_figures(seen, capture_s, 3 if quick else 8)
            steps.begin("taps of the tasks")
            yield from task_taps(seen, store, TODAY)
            steps.begin("axe")
            sizes = ("phone",) if quick else tuple(SIZES)
            words = f"axe, all rules, all pages, {', '.join(sizes)}, two themes"
            yield Figure(words, axe_findings(seen, store, sizes), "", "<= 0")


def result_s() -> float:
    """Return how long all networks and methods take for a capture in memory."""
    captures = [replace(ref.load(), masks=()) for ref in open_source(example_captures())]
    measurer = Measurer(Settings(fruit_from="models").options)
    for capture in captures:
        measurer.measure(capture)
    begun_s = time.perf_counter()
    for capture in captures:
        measurer.measure(capture)
    return (time.perf_counter() - begun_s) / len(captures)


def walk_figures(
    browser: Any, path: Path, presses: int, environment: dict[str, str]
) -> Iterator[Figure]:
    """Watch the preview of a walk, and press as fast as somebody walks."""
    from tests.conftest import record
    from tests.greenhouse.conftest import WALK

    write_settings(Settings(fruit_from="models"), settings_file(str(path)))
    with open_store(path) as store:
        store.save_round(WALK)
    recording = record(path.with_suffix(".db3"), 150, scene=passing, enlarged=4)
    with dashboard_served(browser, path, recording, environment) as seen:
        yield Figure("first page after a start, no stop yet", seen.first_s, "s", "<= 2")
        moving, _ = seen.received(5.0)
        words = "preview of 1280x720 while it moves, pictures a second"
        yield Figure(words, moving / 5, "/s", ">= 10")
        for _ in range(presses):
            seen.page.locator("button.take").tap()
            seen.page.wait_for_timeout(100)
        seen.page.locator("#presses .waiting").first.wait_for(state="hidden")
        words = "presses that are one stop each"
        yield Figure(words, 100 * saved_presses(path) / presses, "%", ">= 100")


def saved_presses(path: Path) -> int:
    """Return how many captures are stops, or wait to be measured."""
    waiting = WaitingCaptures(waiting_folder(str(path)))
    keys = {waits.key for waits in (*waiting.captures(), *waiting.set_aside())}
    with open_store(path) as store:
        keys |= {stop.key for walk in store.rounds() for stop in store.stops(walk.key)}
    return len(keys)


def passing(index: int) -> tuple[NDArray[np.uint16], NDArray[np.uint8]]:
    """Draw a frame of a walk: a wall of leaves passes by, 24 pixels of 1280 a frame."""
    rng = np.random.default_rng(3)
    leaves = rng.integers(20, 200, (18, 32, 3), np.uint8)
    color = cv2.resize(leaves, (320, 180), interpolation=cv2.INTER_CUBIC)
    depth = cv2.resize(leaves[..., 0].astype(np.uint16) + 450, (320, 180))
    shift = -6 * index % 320
    return np.roll(depth, shift, axis=1), np.roll(color, shift, axis=1)


def filled_house(path: Path) -> Path:
    """Fill a house: rounds of yesterday and today, and one of 320 stops."""
    from tests.greenhouse.conftest import WALK, long_round

    write_settings(Settings(fruit_from="models"), settings_file(str(path)))
    now_s = time.time()
    with open_store(path) as store:
        store.save_round(WALK)
        add_captures(store, WALK.key, [example_captures()], GIVEN)
        stops = [store.stop(stop.key) for stop in store.stops(WALK.key)]
        long_round(store, stops[0], 320)
        for key, begun_s in ((YESTERDAY, now_s - 86400), (TODAY, now_s)):
            store.save_round(Round(key, "morning", WALK.house, begun_s, WALK.profile))
            for number, stop in enumerate(stops):
                moved = replace(stop, key=key_of(key, number), round_key=key)
                store.save_stop(replace(moved, taken_s=begun_s + number))
    return path


def page_figures(seen: Visit, plain: Visit, rounds: int) -> Iterator[Figure]:
    """Compare pages of a round of 320 stops with plain ones, opened in turns.

    Both servers have started and have no other work meanwhile.
    """
    from tests.greenhouse.conftest import LONG

    yield Figure("first page after a start, full house", seen.first_s, "s", "<= 2")
    yield Figure("the same, times a plain one", seen.first_s / plain.first_s, "x")
    seen.idle()
    cold: dict[str, list[float]] = {name: [] for name in SHOWN}
    within: dict[str, list[float]] = {name: [] for name in SHOWN}
    for number in range(rounds + 1):  # the first time all is read anew
        for name, shown in SHOWN.items():
            plain_s = plain.open("/second", "h1:has-text('Second')")
            plain.idle()
            cold_s = seen.open(f"/{name}?round={LONG.key}", shown)
            seen.idle()
            cold[name] += [cold_s / plain_s] if number else []
        for name, shown in SHOWN.items():
            plain_s = plain.go("first", "h1:has-text('First')")
            plain.go("second", "h1:has-text('Second')")
            way = seen.page.locator(".st-key-nav a").filter(has_text=re.compile(name, re.I))
            within_s = seen.seconds(way.click, shown)
            seen.idle()
            within[name] += [within_s / plain_s] if number else []
    for words, ratios in (("opened anew", cold), ("from another page", within)):
        label = f"pages of 320 stops, {words}, times a plain one"
        typical = median(ratio for page_ratios in ratios.values() for ratio in page_ratios)
        yield Figure(f"{label}: median", typical, "x", "<= 1.3")
        for name, page_ratios in ratios.items():
            yield Figure(f"{label}: {name}", median(page_ratios), "x")


def tap_figures(seen: Visit, capture_s: float, rounds: int) -> Iterator[Figure]:
    """Time presses until their result, and outlines drawn anew by a tap until they are saved."""
    page = seen.page
    page.get_by_text("Loading the networks").first.wait_for(state="hidden")
    seen.open(f"/capture?round={TODAY}", "button.take:enabled")
    page.wait_for_timeout(2000)
    taken_s = []
    words = page.locator("#where").inner_text()
    stops = int(re.findall(r"Stop (\d+)", f"{words} Stop 0")[0])
    for number in range(stops + 1, stops + rounds + 2):
        shown = f"#where:has-text('Stop {number}:')"
        taken_s.append(seen.seconds(page.locator("button.take").tap, shown))
        page.wait_for_timeout(2000)
    press_s = median(taken_s[1:])
    yield Figure("a press to its result", press_s, "s", "<= 0.5")
    yield Figure("a press to its result, times a capture", press_s / capture_s, "x")
    seen.open(f"/results?round={TODAY}", ".fruit button")
    fruit_s = seen.seconds(page.locator(".fruit button").first.click, "svg.view polygon")
    yield Figure("tap to screen: fruit", fruit_s, "s", "<= 0.4")
    outlines_s, redrawn_s = [], []
    for _ in range(rounds):
        page.get_by_role("button", name="Redraw by tap").click()
        page.wait_for_timeout(1000 * TIME_TO_AIM_S)
        begun_s = time.perf_counter()
        outlines_s.append(seen.seconds(page.locator("svg.view").click, OUTLINE))
        seen.seconds(lambda: None, MEASURED)
        redrawn_s.append(time.perf_counter() - begun_s)
        seen.idle()
        page.locator("[class*='st-key-chevron_right'] button").click()
        page.get_by_text("Saved: measured with this outline").wait_for(state="hidden")
        page.locator("svg.view polygon").first.wait_for()
    words = "tap to the outline, of a capture"
    yield Figure(f"{words}: first of a picture", outlines_s[0] / capture_s, "x")
    yield Figure(words, median(outlines_s[1:]) / capture_s, "x", "<= 0.2")
    yield Figure("tap to the new length, saved, of a press", median(redrawn_s) / press_s, "x")


def axe_findings(seen: Visit, path: Path, sizes: tuple[str, ...]) -> int:
    """Return how many elements of all pages break a rule of axe, in both themes."""
    from axe_playwright_python.sync_playwright import Axe
    from tests.greenhouse.pages.test_app_sizes import PAGES

    with open_store(path) as store:
        fruit = next(view for view in store.detections(TODAY) if view.length_m)
    findings = 0
    for path_words, words in PAGES.values():
        address = path_words.format(fruit=fruit.key, stop=fruit.stop_key)
        joint = "&" if "?" in address else "?"
        for size in sizes:
            width, height = SIZES[size]
            seen.page.set_viewport_size({"width": width, "height": height})
            seen.open(f"{address}{joint}round={TODAY}", f"text={words} >> visible=true")
            seen.idle()
            for theme in ("light", "dark"):
                seen.page.emulate_media(color_scheme=theme)
                seen.page.wait_for_timeout(300)
                rules = Axe().run(seen.page).response["violations"]
                findings += sum(len(rule["nodes"]) for rule in rules)
    return findings
