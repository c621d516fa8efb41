"""Click about in the dashboard without sense, and count what it does not bear.

    python benchmarks/hammer.py [--minutes 15] [--seed 1]

A store with the bundled captures and a made round of 40 stops is served. Two pages of one Chromium,
a tablet's and a phone's, are clicked, typed and drawn into by turns, faster than the pages follow.
What to do is drawn from the seed; when it is done depends on the machine. Printed are the pages
visited, what was done, and what must not be: exceptions on a page, errors of its scripts, pages
that crashed, tracebacks of the server. The first of each is told with what led to it.
"""

from __future__ import annotations

import argparse
import random
import shutil
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections import Counter, deque
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from made_stops import made_round, made_stop
from playwright.sync_api import Error, sync_playwright

from cucumbervision.capture.readers import open_source
from cucumbervision.capture.source import bundled_captures
from cucumbervision.dashboard.measuring import SharedMeasurer
from cucumbervision.perception.registry import load_registry
from cucumbervision.pipeline.options import MeasureOptions
from cucumbervision.store.records import RoundRecord
from cucumbervision.store.repository import open_store

FLAGS = (
    *("--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
)
SIZES = ((1280, 800), (390, 844))
STOPS = 40
PATHS = ("", "capture", "upload", "results", "map", "forecast", "accuracy", "settings")
TYPED = ("1", "3", "0.4", "12.5", "-1", "9999", "north", "", "ä 'x' <b>")
FAULTS = (
    *("exceptions shown", "script errors", "page crashes", "browser errors"),
    *("tracebacks of the server", "ends of the server"),
)
BEFORE = 8  # actions told before a fault
# What can be clicked, shadow trees included: one of it is drawn, and brought into view.
PICK = """(share) => {
  const found = [];
  const wanted = 'button, [data-testid="stTopNavLink"], [role="tab"], [role="option"], label, '
    + '[role="checkbox"], [role="radio"], input:not([type=file]), textarea, summary, canvas, '
    + 'svg.view';
  const menu = '[data-testid="stMainMenu"]';
  const walk = (root) => {
    for (const one of root.querySelectorAll('*')) {
      if (one.shadowRoot) walk(one.shadowRoot);
      if (!one.matches(wanted) || one.disabled || one.closest(menu)) continue;
      const box = one.getBoundingClientRect();
      if (box.width > 2 && box.height > 2) found.push(one);
    }
  };
  walk(document);
  if (!found.length) return null;
  const one = found[Math.floor(share * found.length)];
  one.scrollIntoView({block: 'center'});
  const box = one.getBoundingClientRect();
  const words = one.getAttribute('aria-label') || one.innerText || one.placeholder || '';
  return {tag: one.tagName.toLowerCase(), words: words.trim().slice(0, 40),
    x: box.x, y: box.y, width: box.width, height: box.height};
}"""
SHOWN = """() => [...document.querySelectorAll('[data-testid="stException"], [role="dialog"]')]
  .map((one) => one.innerText)
  .filter((text) => /Traceback|Error:|Bad message|cannot be called|delta path/.test(text))"""


@dataclass
class Found:
    """What was done, and what was not borne."""

    done: Counter[str] = field(default_factory=Counter)
    pages: Counter[str] = field(default_factory=Counter)
    faults: Counter[str] = field(default_factory=Counter)
    last: deque[str] = field(default_factory=lambda: deque(maxlen=BEFORE))

    def fault(self, kind: str, words: str) -> None:
        """Count a fault; tell the first of each."""
        if not self.faults[kind]:
            print(f"{kind}: {words}\n  after: " + "; ".join(self.last), flush=True)
        self.faults[kind] += 1


def make_store(path: Path) -> None:
    """Save the bundled captures, measured, and a made round of today."""
    measurer, drawn = (
        SharedMeasurer(load_registry()),
        RoundRecord(name="drawn", profile="long-cucumber"),
    )
    day = int((time.time() - made_round("").started_s) // 86400)
    made = replace(made_round("made", day), profile=drawn.profile)
    with open_store(path) as store:
        store.save_round(drawn)
        for ref in open_source(bundled_captures()):
            measurer.take_stop(store, drawn.key, ref.load(), MeasureOptions())
        store.save_round(made)
        for number in range(STOPS):
            store.save_stop(made_stop(made, number, store.images))


def bring_back(path: Path) -> None:
    """Bring back the rounds that were deleted on the way."""
    with open_store(path) as store:
        for one in store.rounds(deleted=True):
            store.restore_round(one.key)


def act(page: Any, address: str, draw: random.Random, found: Found) -> None:
    """Do one thing."""
    links = page.get_by_test_id("stTopNavLink").all() if draw.random() < 0.05 else []
    if links:
        draw.choice(links).click(force=True)
        found.done["pages chosen"] += 1
        return
    if draw.random() < 0.02:
        page.goto(f"{address}/{draw.choice(PATHS)}", wait_until="commit")
        found.done["addresses typed"] += 1
        return
    one = page.evaluate(PICK, draw.random())
    if one is None:
        page.wait_for_timeout(100)
        return
    at = (draw.uniform(0.1, 0.9), draw.uniform(0.1, 0.9))
    x, y = one["x"] + at[0] * one["width"], one["y"] + at[1] * one["height"]
    found.last.append(f"{page.url.rsplit('/', 1)[-1] or 'today'}: {one['tag']} '{one['words']}'")
    page.mouse.move(x, y)
    page.mouse.down()
    if one["tag"] in {"canvas", "svg"} and draw.random() < 0.4:
        page.mouse.move(x + draw.uniform(-80, 80), y + draw.uniform(-80, 80), steps=3)
    page.mouse.up()
    found.done["clicks"] += 1
    if one["tag"] in {"input", "textarea"} and draw.random() < 0.7:
        page.keyboard.press("Control+a")
        page.keyboard.type(draw.choice(TYPED))
        page.keyboard.press(draw.choice(("Enter", "Tab", "Escape")))
        found.done["texts typed"] += 1


def look(page: Any, address: str, found: Found) -> None:
    """Count what a page shows that it must not, and begin anew then."""
    found.pages[page.url.split("?")[0].rsplit("/", 1)[-1] or "today"] += 1
    for text in page.evaluate(SHOWN):
        found.fault("exceptions shown", text)
        page.goto(address, wait_until="commit")


def hammer(browser: Any, address: str, path: Path, seed: int, minutes: float) -> Found:
    """Click until the time is over."""
    found, draw, pages = Found(), random.Random(seed), []
    for width, height in SIZES:
        page = browser.new_page(viewport={"width": width, "height": height})
        page.set_default_timeout(60_000)
        page.on("pageerror", lambda error: found.fault("script errors", str(error)))
        page.on("crash", lambda _: found.fault("page crashes", "the browser gave it up"))
        page.goto(address)
        pages.append(page)
    until, tidy = time.monotonic() + 60 * minutes, time.monotonic()
    while time.monotonic() < until:
        if time.monotonic() > tidy:
            bring_back(path)
            tidy += 60
            faults = sum(found.faults.values())
            print(f"{found.done['clicks']} clicks, {faults} faults", file=sys.stderr, flush=True)
        page = draw.choice(pages)
        try:
            act(page, address, draw, found)
            page.wait_for_timeout(draw.choice((0, 0, 30, 100, 400)))
            look(page, address, found)
        except Error as error:  # the page was drawn anew under the mouse
            if "context was destroyed" not in str(error) and "navigat" not in str(error):
                found.fault("browser errors", str(error).splitlines()[0])
                page.goto(address, wait_until="commit")
    return found


def served(path: Path, log: Path, port: int) -> subprocess.Popen[bytes]:
    """Start the dashboard and wait until it answers."""
    code = "from cucumbervision.cli.app import main; main()"
    command = [sys.executable, "-c", code, "dashboard", "--no-browser", "--port", str(port)]
    with log.open("wb") as out:
        server = subprocess.Popen(
            [*command, "--store", str(path)], cwd=path.parent, stdout=out, stderr=out
        )
    if not answers(server, f"http://127.0.0.1:{port}"):
        raise SystemExit(log.read_text())
    return server


def answers(server: subprocess.Popen[bytes], address: str) -> bool:
    """Wait until a dashboard answers; return whether it did before it ended."""
    while server.poll() is None:
        try:
            urllib.request.urlopen(f"{address}/_stcore/health", timeout=10).close()
        except OSError:
            time.sleep(0.3)
        else:
            return True
    return False


def main() -> None:
    """Serve, click, and say what came of it; 1 where something was not borne."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=15.0)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    with socket.socket() as probe, tempfile.TemporaryDirectory() as folder:
        path, log = Path(folder) / "house.db", Path(folder) / "server.log"
        make_store(path)
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
        probe.close()
        server = served(path, log, port)
        try:
            with sync_playwright() as driver:
                chromium = shutil.which("chromium") or shutil.which("chromium-browser")
                browser = driver.chromium.launch(executable_path=chromium, args=list(FLAGS))
                address = f"http://127.0.0.1:{port}"
                found = hammer(browser, address, path, given.seed, given.minutes)
                browser.close()
            if server.poll() is not None:
                found.fault("ends of the server", f"exit code {server.returncode}")
        finally:
            server.terminate()
            server.wait(60)
        for part in log.read_text().split("Traceback")[1:]:
            found.fault("tracebacks of the server", part[-3000:])
    pages = ", ".join(f"{name} {many}" for name, many in sorted(found.pages.items()))
    done = ", ".join(f"{many:,} {name}" for name, many in sorted(found.done.items()))
    print(f"{given.minutes:g} minutes, seed {given.seed}: {done}\npages by clicks: {pages}")
    for kind in FAULTS:
        print(f"{kind}: {found.faults[kind]}")
    sys.exit(bool(found.faults.total()))


if __name__ == "__main__":
    main()
