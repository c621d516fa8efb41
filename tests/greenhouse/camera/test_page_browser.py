"""A press is one stop of its moment: by key and touch, offline and over a restart."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Callable, Iterator
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.greenhouse.conftest import wait_until

from cucumbervision.capture.source import example_captures
from cucumbervision_greenhouse.store.records import Round, key_of
from cucumbervision_greenhouse.store.repository import open_store
from cucumbervision_greenhouse.store.waiting import WaitingCaptures, waiting_folder

pytest.importorskip("streamlit")
pytest.importorskip("pyrealsense2", exc_type=ImportError)


from cucumbervision_greenhouse.rounds.adding import stored_capture
from cucumbervision_greenhouse.settings import Settings, settings_file, write_settings

WALK = Round(key_of("presses"), "presses", "", 1_700_000_000.0, "long-cucumber")


class Walk:
    """A round that a page of the camera's is open on; a recording plays in its place."""

    def __init__(self, folder: Path, recording: Path, start: Callable[..., Any]) -> None:
        self.folder, self.store = folder, folder / "house.db"
        with open_store(self.store) as store:
            store.save_round(WALK)
        self._waiting = WaitingCaptures(waiting_folder(str(self.store)))
        self.address = start(folder, "--store", str(self.store), "--replay", str(recording))
        self.server: subprocess.Popen[bytes] = self.address.process

    def kill(self) -> None:
        """Kill the server."""
        self.server.kill()
        self.server.wait()

    def start_again(self) -> None:
        """Start it at its address."""
        with (self.folder / "server.log").open("ab") as log:
            self.server = subprocess.Popen(
                self.server.args, stdout=log, stderr=log, cwd=self.folder
            )

    def kept(self) -> set[str]:
        """Return the keys of all presses that were kept."""
        waiting = {one.key for one in (*self._waiting.captures(), *self._waiting.set_aside())}
        with open_store(self.store) as store:
            rounds = [one.key for one in store.rounds()]  # drawn captures have one of their own
            return waiting | {stop.key for key in rounds for stop in store.stops(key)}

    def pictures(self) -> set[float]:
        """Return how far the block is in each picture: 1 mm farther in each frame."""
        found = []
        for one in (*self._waiting.captures(), *self._waiting.set_aside()):
            depth_m = one.load().depth_m
            found.append(float(depth_m[depth_m.shape[0] // 2, depth_m.shape[1] // 2]))
        with open_store(self.store) as store:
            for stop in store.stops(WALK.key):
                record = store.stop(stop.key)
                depth_m = stored_capture(store.images, record.captures[0], record).depth_m
                found.append(float(depth_m[depth_m.shape[0] // 2, depth_m.shape[1] // 2]))
        return set(np.round(found, 4))


def opened(page: Any, walk: Walk) -> Any:
    page.goto(f"{walk.address}/capture")
    page.locator("button.take:enabled").wait_for()
    page.wait_for_function("document.getElementById('color').naturalWidth > 0")
    page.wait_for_timeout(2000)
    return page


def wait_for_stops(page: Any, walk: Walk, number: int) -> None:
    wait_until(page, lambda: len(walk.kept()) >= number)
    page.wait_for_timeout(3000)  # one too many would come now
    assert len(walk.kept()) == number


@pytest.fixture
def walk(
    tmp_path: Path, make_recording: Callable[..., Path], start_server: Callable[..., Any]
) -> Iterator[Walk]:
    walk = Walk(tmp_path, make_recording(tmp_path / "walk.db3", 300), start_server)
    yield walk
    walk.kill()


def test_a_press_is_one_stop_however_it_is_made(walk: Walk, new_page: Callable[..., Any]) -> None:
    page = opened(new_page(has_touch=True, timezone_id="Pacific/Auckland"), walk)
    pressed = datetime.now()
    page.keyboard.press("Enter")
    wait_until(page, lambda: len(walk.kept()) == 1)
    clock = datetime.strptime(page.locator("#presses li").inner_text()[2:10], "%H:%M:%S")
    pressed = pressed.replace(microsecond=0)
    assert (clock - pressed).seconds < 60  # the server's clock, not the viewer's
    page.locator("button.take").tap()
    wait_until(page, lambda: len(walk.kept()) == 2)
    page.locator("button.take").click()
    wait_until(page, lambda: len(walk.kept()) == 3)
    for key in ("Enter", "Space"):  # the button has the focus now
        page.keyboard.press(key)
        page.wait_for_timeout(300)
    page.keyboard.down("Enter")
    for _ in range(5):
        page.keyboard.down("Enter")  # a key that is held repeats itself
    page.keyboard.up("Enter")
    wait_until(page, lambda: len(walk.kept()) == 6)
    page.goto(f"{walk.address}/results")
    page.goto(f"{walk.address}/capture")
    page.locator("button.take:enabled").wait_for()
    page.keyboard.press("Enter")
    wait_for_stops(page, walk, 7)


def test_sound_and_vibration_are_switched_off_on_a_device(
    walk: Walk, new_page: Callable[..., Any]
) -> None:
    page = new_page()
    page.add_init_script("window.felt = 0; navigator.vibrate = () => Boolean(window.felt += 1)")
    page.goto(f"{walk.address}/capture?round={WALK.key}")
    take = page.locator("button.take:enabled")
    take.click()
    assert page.evaluate("felt") == 1
    page.get_by_role("button", name="Sound and vibration").click()
    page.reload()
    take.click()
    assert page.evaluate("felt") == 0
    assert page.locator("#felt").get_attribute("aria-pressed") == "false"


def test_presses_while_offline_each_get_their_picture(
    walk: Walk, new_page: Callable[..., Any]
) -> None:
    page = opened(new_page(), walk)
    page.context.set_offline(True)
    for _ in range(4):
        page.locator("button.take").click()
        page.wait_for_timeout(1000)
    page.context.set_offline(False)
    wait_for_stops(page, walk, 4)
    assert len(walk.pictures()) == 4


def test_the_page_is_installed_and_takes_presses_while_the_server_is_away(
    walk: Walk, new_page: Callable[..., Any]
) -> None:
    page = opened(new_page(locale="nl-NL"), walk)
    asked = page.context.new_cdp_session(page)
    manifest = asked.send("Page.getAppManifest")
    assert manifest["errors"] == []
    assert manifest["manifest"]["startUrl"] == f"{walk.address}/capture"
    assert "standalone" in manifest["data"]
    # A browser of tests keeps nothing, which Chromium calls incognito; nothing else is missing.
    missing = asked.send("Page.getInstallabilityErrors")["installabilityErrors"]
    assert {error["errorId"] for error in missing} <= {"in-incognito"}
    page.evaluate("navigator.serviceWorker.ready.then(() => true)")
    page.reload()  # from now on it is the worker's
    page.locator("button.take:enabled").wait_for()
    page.context.set_offline(True)
    # As from the home screen. The worker kept it in its own language, and is asked in Dutch.
    page.goto("about:blank")
    page.goto(f"{walk.address}/capture", timeout=60_000)
    page.locator("button.take:enabled").wait_for()
    assert page.locator("button.take span").first.inner_text() == "Foto nemen"
    page.locator("#lost").get_by_text("Verbinding met de cameracomputer").wait_for()
    page.locator("button.take").click()
    page.locator("#lost").get_by_text("1 opname staat op dit apparaat").wait_for()
    page.context.set_offline(False)
    wait_for_stops(page, walk, 1)


def test_positions_are_in_the_unit_that_was_chosen(
    tmp_path: Path,
    make_recording: Callable[..., Path],
    start_server: Callable[..., Any],
    new_page: Callable[..., Any],
) -> None:
    write_settings(Settings(unit="in"), settings_file(str(tmp_path / "house.db")))
    walk = Walk(tmp_path, make_recording(tmp_path / "walk.db3", 300), start_server)
    page = opened(new_page(), walk)
    position = page.get_by_label("Next stop at [ft]")
    assert position.input_value() == "0.00"
    page.get_by_label("Step [ft]").fill("2")
    position.fill("4")
    position.press("Tab")
    for number in (1, 2):
        page.locator("button.take").click()
        wait_until(page, lambda: len(walk.kept()) == number)  # noqa: B023
    assert position.input_value() == "8.00"
    with open_store(walk.store) as store:
        wait_until(page, lambda: len(store.stops(WALK.key)) == 2)
        stops = store.stops(WALK.key)
    at_m = sorted(stop.position_m or 0.0 for stop in stops)
    assert at_m == pytest.approx([4 * 0.3048, 6 * 0.3048], abs=0.006)
    page.locator("#where").get_by_text("6.00 ft").wait_for()
    walk.kill()


def test_presses_whose_pictures_a_kill_took_are_said_and_their_place_is_asked_for(
    walk: Walk, new_page: Callable[..., Any]
) -> None:
    page = opened(new_page(), walk)
    position, take = page.locator("#position"), page.locator("button.take")
    position.fill("0.60")
    page.locator("#step").fill("0.30")
    page.locator("#step").blur()
    take.click()
    wait_for_stops(page, walk, 1)
    walk.kill()
    for _ in range(3):
        take.click()
        page.wait_for_timeout(700)
    page.get_by_text("3 presses are kept on this device").wait_for()
    page.wait_for_timeout(2000)
    walk.start_again()
    page.get_by_text("3 lost: row 1, left, 0.90 to 1.50 m").wait_for()
    assert len(walk.kept()) == 1
    # Nobody knows where the walker is by now.
    page.locator("#told").get_by_text("enter where the next stop is").wait_for()
    assert position.input_value() == ""
    assert take.is_disabled()
    position.fill("0.90")
    take.click()
    wait_for_stops(page, walk, 2)
    page.locator("#presses .refused button").click()
    assert page.locator("#presses .refused").count() == 0


def test_a_line_that_is_half_open_is_said(walk: Walk, new_page: Callable[..., Any]) -> None:
    page = opened(new_page(), walk)
    assert page.locator("#lost").is_hidden()
    os.kill(walk.server.pid, signal.SIGSTOP)  # its connections stay open, and bring nothing
    try:
        page.get_by_text("Connection to the camera computer lost").wait_for()
        page.locator("button.take").click()
        page.get_by_text("1 press is kept on this device").wait_for()
    finally:
        os.kill(walk.server.pid, signal.SIGCONT)
    page.locator("#lost").wait_for(state="hidden")
    wait_for_stops(page, walk, 1)


def test_presses_of_a_page_that_was_closed_offline_are_sent_by_another(
    tmp_path: Path, start_server: Callable[..., Any], new_page: Callable[..., Any]
) -> None:
    walk = Walk(tmp_path, example_captures(), start_server)
    first = new_page()
    second = first.context.new_page()
    for page in (first, second):
        page.goto(f"{walk.address}/capture?round={WALK.key}")
        page.locator("button.take:enabled").wait_for()
    first.context.set_offline(True)
    for page in (first, second):
        page.locator("button.take").click()
        page.get_by_text("waiting on this device").wait_for()
    second.wait_for_timeout(2000)  # what a page keeps is on the disk a moment later
    second.close()
    first.context.set_offline(False)
    wait_for_stops(first, walk, 2)
