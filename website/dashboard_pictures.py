"""Take screenshots of the dashboard's pages for the documentation.

    python website/dashboard_pictures.py

Serves the bundled captures from an empty folder, as a tablet and a phone see them in Chromium
(Debian's `chromium`, Playwright), into `docs/images/dashboard-*.png`.
"""

from __future__ import annotations

import shutil
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from playwright.sync_api import sync_playwright

IMAGES = Path(__file__).parents[1] / "docs" / "images"
FLAGS = (
    *("--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
)
# A text that a page shows once it is complete.
PAGES = {
    "today": ("", "Pick list"),
    "capture": ("capture", "Depth seen"),
    "map": ("map", "true size"),
    "results": ("results", "tap one to open it"),
}
ON_PHONE = ("capture",)  # in both themes, side by side


def main() -> None:
    """Serve the dashboard and take the screenshots."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = str(probe.getsockname()[1])
    code = "from cucumbervision.cli.app import main; main()"
    command = [sys.executable, "-c", code, "dashboard", "--no-browser", "--port", port]
    with tempfile.TemporaryDirectory() as folder:
        store = ["--store", str(Path(folder) / "house.db")]
        with subprocess.Popen([*command, *store], cwd=folder) as server:
            try:
                take(f"http://127.0.0.1:{port}")
            finally:
                server.terminate()


def take(address: str) -> None:
    """Take a picture of each page, and of one fruit."""
    while True:
        try:
            urllib.request.urlopen(f"{address}/_stcore/health", timeout=10).close()
            break
        except OSError:
            time.sleep(0.5)
    with sync_playwright() as driver:
        chromium = shutil.which("chromium")
        browser = driver.chromium.launch(executable_path=chromium, args=list(FLAGS))
        page = browser.new_page(viewport={"width": 1280, "height": 800})
        page.set_default_timeout(300_000)
        page.goto(f"{address}/results")
        page.get_by_test_id("stMetricValue").first.filter(has_text="8").wait_for()  # all its fruit
        for name, (path, words) in PAGES.items():
            page.goto(f"{address}/{path}")
            page.get_by_text(words).first.wait_for()
            shoot(page, name)
        page.locator(".fruit button").first.click()
        page.locator("svg.view polygon").first.wait_for()
        shoot(page, "fruit")
        phones = []
        for name in ON_PHONE:
            for theme in ("light", "dark"):
                page = browser.new_page(
                    viewport={"width": 390, "height": 844}, color_scheme=theme, has_touch=True
                )
                page.set_default_timeout(300_000)
                path, words = PAGES[name]
                page.goto(f"{address}/{path}")
                page.get_by_text(words).first.wait_for()
                phones.append(shoot(page, name, is_kept=False))
        pictures = [np.asarray(Image.open(BytesIO(content))) for content in phones]
        Image.fromarray(np.hstack(pictures)).save(IMAGES / "dashboard-phone.png")
        browser.close()


def shoot(page: Any, name: str, *, is_kept: bool = True) -> bytes:
    """Return a screenshot, and save it under a name."""
    page.get_by_text("Loading the networks").first.wait_for(state="hidden")
    page.get_by_test_id("stSkeleton").first.wait_for(state="hidden")
    page.wait_for_timeout(8000)  # tables load their pictures last, without a visible sign
    path = IMAGES / f"dashboard-{name}.png" if is_kept else None
    screenshot: bytes = page.screenshot(path=path)
    return screenshot


if __name__ == "__main__":
    main()
