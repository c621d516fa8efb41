"""A dashboard, or a plain page of Streamlit, in Chromium; both have the same cores."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

LOOK_MS = 10  # between two looks for what a page is to show
PATIENCE_S = 60.0
IDLE = "[data-test-script-state=notRunning]"
PLAIN = """
import streamlit as st

def first(): st.title("First")
def second(): st.title("Second")

st.navigation([st.Page(first, default=True), st.Page(second)]).run()
"""
"""A page of Streamlit with nothing on it, and another one to go to."""


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

    def go(self, name: str, shown: str) -> float:
        """Follow a link of the page, and return how long that takes."""
        taken_s = self.seconds(self.page.get_by_role("link", name=name).click, shown)
        self.idle()
        return taken_s

    def idle(self) -> None:
        """Wait until Streamlit has drawn the page, if it is one of its pages."""
        if self.page.locator(".stApp").count():
            self.page.locator(IDLE).first.wait_for(state="attached")

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
def chromium() -> Iterator[Any]:
    """Start Chromium, as the tests do."""
    from playwright.sync_api import sync_playwright
    from tests.greenhouse.conftest import FLAGS

    with sync_playwright() as web:
        path = shutil.which("chromium") or shutil.which("chromium-browser")
        yield web.chromium.launch(executable_path=path, args=list(FLAGS))


def compiled(folder: Path) -> dict[str, str]:
    """Return an environment in which all that servers import is compiled, as where it is installed.

    Python keeps it in a folder.
    """
    environment = {**os.environ, "PYTHONPYCACHEPREFIX": str(folder), "CUCUMBERVISION_LOGIN": "none"}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    names = ("guarded_app", "app", "charts")
    modules = ", ".join(f"cucumbervision_greenhouse.pages.{name}" for name in names)
    code = f"import streamlit.web.cli, uvicorn, cucumbervision.cli.app, {modules}"
    quiet = subprocess.DEVNULL
    subprocess.run([sys.executable, "-c", code], check=True, env=environment, stderr=quiet)
    return environment


@contextmanager
def _served(
    browser: Any, command: Sequence[str], port: int, shown: str, environment: dict[str, str]
) -> Iterator[Visit]:
    """Start a server on the loopback, and give a page of the browser that opens it."""
    quiet, address = subprocess.DEVNULL, f"http://127.0.0.1:{port}"
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


def _free_port() -> int:
    """Return a port that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def dashboard_served(
    browser: Any, store: Path, replay: Path, environment: dict[str, str], shown: str = "h1"
) -> Iterator[Visit]:
    """Serve a dashboard, and open a page on it."""
    code, port = "from cucumbervision.cli.app import main; main()", _free_port()
    words = ["--no-browser", "--port", str(port), "--store", str(store), "--replay", str(replay)]
    command = [sys.executable, "-c", code, "dashboard", *words]
    with _served(browser, command, port, shown, environment) as seen:
        yield seen


@contextmanager
def plain_served(browser: Any, folder: Path, environment: dict[str, str]) -> Iterator[Visit]:
    """Serve the plain page from a folder, and open a page on it."""
    script, port = folder / "plain.py", _free_port()
    script.write_text(PLAIN, encoding="utf-8")
    options = ("--server.headless=true", f"--server.port={port}", "--server.address=127.0.0.1")
    command = [sys.executable, "-m", "streamlit", "run", str(script), *options]
    with _served(browser, command, port, "h1:has-text('First')", environment) as seen:
        yield seen
