"""A real Chromium walks the pages of a real server on a fresh machine."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from cucumbervision.capture.source import bundled_captures
from cucumbervision.store.repository import open_store

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
FLAGS = (
    *("--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
)
TABLET, UPRIGHT = {"width": 1280, "height": 800}, {"width": 800, "height": 1280}
PATIENCE_MS = 150_000  # on a machine that does much else; some seconds on an idle one

pytestmark = [
    pytest.mark.timeout(600),
    pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed"),
]


@dataclass
class Dashboard:
    """A browser's page on a running server."""

    page: Any
    store: Path
    artefacts: Path
    hosts: set[str]
    faults: list[str]

    def go(self, name: str) -> None:
        self.page.get_by_test_id("stTopNavLink").filter(has_text=name).click()
        self.quiet()

    def quiet(self) -> None:
        """Wait until nothing is being drawn any more."""
        until = time.monotonic() + PATIENCE_MS / 1000
        still = 0
        while still < 3 and time.monotonic() < until:
            drawing = self.page.locator('[data-testid="stSkeleton"]').count()
            still = 0 if drawing else still + 1
            self.page.wait_for_timeout(200)

    def shot(self, name: str) -> None:
        """Keep a picture of the whole page, at both ways of holding a tablet."""
        for way, size in (("wide", TABLET), ("upright", UPRIGHT)):
            self.page.set_viewport_size(size)
            self.page.wait_for_timeout(400)
            self.page.screenshot(path=self.artefacts / f"dashboard-{name}-{way}.png")
        self.page.set_viewport_size(TABLET)


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def wait_for_server(address: str, server: subprocess.Popen[bytes]) -> None:
    until = time.monotonic() + PATIENCE_MS / 1000
    while time.monotonic() < until:
        assert server.poll() is None, "the server ended"
        try:
            with urllib.request.urlopen(f"{address}/_stcore/health", timeout=5):
                return
        except (urllib.error.URLError, OSError):
            time.sleep(0.2)
    raise AssertionError("the server does not answer")


@pytest.fixture(scope="module")
def dashboard(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Dashboard]:
    pytest.importorskip("streamlit")
    playwright = pytest.importorskip("playwright.sync_api")
    folder = tmp_path_factory.mktemp("browser")
    artefacts = Path(os.environ.get("CUCUMBERVISION_ARTEFACTS") or folder)
    artefacts.mkdir(parents=True, exist_ok=True)
    port, store = free_port(), folder / "house.db"
    program = Path(sys.executable).with_name("cucumbervision")
    command = [str(program), "dashboard", "--no-browser"]
    where = ["--store", str(store), "--replay", str(bundled_captures()), "--port", str(port)]
    with (folder / "server.log").open("wb") as log:
        server = subprocess.Popen([*command, *where], stdout=log, stderr=log)
    try:
        wait_for_server(f"http://127.0.0.1:{port}", server)
        with playwright.sync_playwright() as driver:
            browser = driver.chromium.launch(executable_path=CHROMIUM, args=list(FLAGS))
            page = browser.new_page(viewport=TABLET)
            page.set_default_timeout(PATIENCE_MS)
            hosts: set[str] = set()
            faults: list[str] = []
            page.on("request", lambda r: hosts.add(r.url.split("/")[2]) if "//" in r.url else None)
            page.on("pageerror", lambda error: faults.append(str(error)))
            page.goto(f"http://127.0.0.1:{port}")
            yield Dashboard(page, store, artefacts, hosts, faults)
            browser.close()
    finally:
        server.terminate()
        server.wait(20)


def test_a_fresh_machine_shows_a_round(dashboard: Dashboard) -> None:
    page = dashboard.page
    page.get_by_text("AGPL-3.0-only").wait_for()
    page.get_by_text("8 fruit", exact=False).first.wait_for()
    dashboard.quiet()
    assert page.get_by_test_id("stMetricValue").first.inner_text() == "8"
    dashboard.shot("results")


def test_a_fruit_is_looked_at_measured_and_accepted(dashboard: Dashboard) -> None:
    page = dashboard.page
    table = page.get_by_test_id("stDataFrame").first
    table.scroll_into_view_if_needed()
    table.click(position={"x": 18, "y": 40 + 32})
    page.get_by_role("button", name="Accept").wait_for()
    picture = page.locator("svg.view")
    picture.wait_for()
    assert picture.locator("polygon").count() == 1
    page.get_by_role("button", name="M3", exact=True).click()
    assert picture.locator("polyline").count() >= 4
    page.get_by_role("button", name="Depth").click()
    page.get_by_role("button", name="Colour").click()

    page.get_by_role("button", name="Ruler").click()
    box = picture.bounding_box()
    page.mouse.click(box["x"] + 0.4 * box["width"], box["y"] + 0.45 * box["height"])
    page.mouse.click(box["x"] + 0.6 * box["width"], box["y"] + 0.45 * box["height"])
    page.get_by_text("Ruler:").wait_for()
    dashboard.shot("fruit")

    page.get_by_role("button", name="Accept", exact=True).click()
    page.get_by_role("button", name="Accepted").wait_for()
    page.get_by_role("tab", name="3D").click()
    page.locator("canvas[role=img]").wait_for()
    dashboard.quiet()
    dashboard.shot("cloud")
    page.get_by_role("button", name="All fruit").click()


def test_a_capture_from_the_replay_is_measured_in_place(dashboard: Dashboard) -> None:
    page = dashboard.page
    dashboard.go("Capture")
    page.locator("svg.view image").first.wait_for()
    page.get_by_test_id("stMain").get_by_role("button", name="Capture").click()
    page.get_by_text("0.00 m: saved").wait_for()
    dashboard.quiet()
    dashboard.shot("capture")
    with open_store(dashboard.store) as store:
        assert [one.stops for one in store.rounds()] == [4]


def test_an_upload_is_measured_and_what_is_no_capture_is_told(
    dashboard: Dashboard, tmp_path: Path
) -> None:
    page = dashboard.page
    packed = tmp_path / "row.zip"
    with zipfile.ZipFile(packed, "w") as archive:
        for path in sorted((bundled_captures() / "simulated-row-a").iterdir()):
            archive.write(path, f"row-a/{path.name}")
    (tmp_path / "odd.png").write_bytes(b"MZ no picture")
    dashboard.go("Upload")
    page.locator("input[type=file]").set_input_files([packed, tmp_path / "odd.png"])
    page.get_by_role("button", name="Measure these files").click()
    page.get_by_text("1 capture saved").wait_for()
    page.get_by_text("odd.png").last.wait_for()
    dashboard.shot("upload")


@pytest.mark.parametrize(
    ("page", "words", "name"),
    [
        ("Row map", "One mark a fruit", "map"),
        ("Forecast", "80 % intervals", "forecast"),
        ("Accuracy", "Measured by hand", "accuracy"),
        ("Settings", "Networks", "settings"),
    ],
)
def test_every_page_is_drawn(dashboard: Dashboard, page: str, words: str, name: str) -> None:
    dashboard.go(page)
    dashboard.page.get_by_text(words).first.wait_for()
    dashboard.quiet()
    dashboard.page.wait_for_timeout(500)
    assert dashboard.page.get_by_text("· AGPL-3.0-only ·").count() == 1
    dashboard.shot(name)


def test_nothing_was_asked_of_another_machine(dashboard: Dashboard) -> None:
    assert {host.split(":")[0] for host in dashboard.hosts} == {"127.0.0.1"}
    assert dashboard.faults == []
