"""How many presses of the capture page become stops, over lost connections and killed servers.

    python benchmarks/presses.py --seconds 300 --gaps 3 --kills 2

A real browser presses twice a second while a recording of 1280 x 720 plays in the camera's place.
The connection is lost for 20 s at a time; the server is killed (SIGKILL) and started again, once
of two times while the connection is lost. Where photos were lost, the place of the next stop is
typed. Stops are counted in the store and in its queue.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # for what the tests draw

from tests.conftest import record

from cucumbervision_greenhouse.camera.cameras import PREVIEW_FPS
from cucumbervision_greenhouse.store.records import Round, key_of
from cucumbervision_greenhouse.store.repository import open_store
from cucumbervision_greenhouse.store.waiting import WaitingCaptures, waiting_folder

WALK = Round(key_of("presses"), "presses", "", 1_700_000_000.0, "long-cucumber")
GAP_S, EVERY_S = 20.0, 0.5
_PATIENCE_S, _MARGIN_S = 300.0, 90.0
_PRESS = """([number, every_ms]) => {
  const [take, position] = ["take", "position"].map((name) => document.getElementById(name));
  const timer = setInterval(() => {
    if (!position.value) { position.value = "1"; position.dispatchEvent(new Event("change")); }
    const touch = { isPrimary: true, button: 0, bubbles: true };
    take.dispatchEvent(new PointerEvent("pointerdown", touch));
    if ((window.pressed = (window.pressed || 0) + 1) === number) clearInterval(timer);
  }, every_ms);
}"""
_LEFT = """() => new Promise((resolve) => {
  const asked = indexedDB.open("cucumbervision", 1);
  asked.onsuccess = () => {
    const all = asked.result.transaction("presses").objectStore("presses").getAll();
    all.onsuccess = () => resolve(all.result.map((one) => [one.state, one.words]));
  };
})"""


@dataclass
class Server:
    """The dashboard, started anew at its address after each kill."""

    folder: Path
    recording: Path
    port: int
    process: subprocess.Popen[bytes] | None = None

    @property
    def address(self) -> str:
        """Where it listens."""
        return f"http://127.0.0.1:{self.port}"

    @property
    def store(self) -> Path:
        """Its store."""
        return self.folder / "house.db"

    def start(self) -> None:
        """Start it, and return at once."""
        code = "from cucumbervision.cli.app import main; main()"
        options = ("--no-browser", "--port", str(self.port), "--store", str(self.store))
        command = [
            sys.executable,
            "-c",
            code,
            "dashboard",
            *options,
            "--replay",
            str(self.recording),
        ]
        with (self.folder / "server.log").open("ab") as log:
            self.process = subprocess.Popen(command, stdout=log, stderr=log, cwd=self.folder)

    def kill(self) -> None:
        """Kill it."""
        if self.process is not None:
            self.process.kill()
            self.process.wait()

    def wait(self) -> None:
        """Wait until it answers."""
        until = time.monotonic() + _PATIENCE_S
        while time.monotonic() < until:
            try:
                urllib.request.urlopen(f"{self.address}/_stcore/health", timeout=5).close()
                return
            except (urllib.error.URLError, OSError):
                time.sleep(0.2)
        raise TimeoutError((self.folder / "server.log").read_text())

    def kept(self) -> int:
        """Return how many presses are stops, or wait on disk to be measured."""
        waiting = WaitingCaptures(waiting_folder(str(self.store)))
        keys = {record.key for record in (*waiting.captures(), *waiting.set_aside())}
        with open_store(self.store) as store:
            return len(keys | {record.key for record in store.stops(WALK.key)})


@dataclass
class Plan:
    """When the connection is lost and the server killed, seconds from the first press."""

    seconds: float
    gaps: int
    kills: int
    events: list[tuple[float, str]] = field(init=False)

    def __post_init__(self) -> None:
        part_s = self.seconds / (self.gaps + 1)
        gaps_s = [part_s * (k + 1) - GAP_S / 2 for k in range(self.gaps)]
        # The first between two gaps, the second within one.
        kills_s = [part_s / 2, *(at_s + GAP_S / 2 for at_s in gaps_s[1:])][: self.kills]
        lost = [(at_s, "lost") for at_s in gaps_s]
        back = [(at_s + GAP_S, "back") for at_s in gaps_s]
        self.events = sorted([*lost, *back, *((at_s, "kill") for at_s in kills_s)])


def walk(page: Any, server: Server, plan: Plan) -> dict[str, Any]:
    """Press through a plan; return how many presses there were, and what became of them."""
    number = round(plan.seconds / EVERY_S)
    page.evaluate(_PRESS, [number, 1000 * EVERY_S])
    began_s, banners = time.monotonic(), 0
    for at_s, event in plan.events:
        page.wait_for_timeout(max(0.0, 1000 * (began_s + at_s - time.monotonic())))
        if event == "kill":
            server.kill()
            server.start()
        else:
            if event == "back":
                banners += page.locator("#lost").is_visible()
            page.context.set_offline(event == "lost")
    page.wait_for_function(f"window.pressed === {number}", timeout=1000 * _PATIENCE_S)
    presses: list[list[str]] = []
    until = time.monotonic() + _PATIENCE_S
    while time.monotonic() < until:
        page.wait_for_timeout(2000)
        presses = page.evaluate(_LEFT)
        if all(state != "waiting" for state, _ in presses):
            break
    words = [words for state, words in presses if state != "waiting"]
    return {
        "pressed": number,
        "saved": server.kept(),
        "refused": len(words),
        "still_waiting": len(presses) - len(words),
        "gaps_with_banner": banners,
        "notices": page.locator("#presses .refused span").all_inner_texts(),
    }


def measure(folder: Path, plan: Plan) -> dict[str, Any]:
    """Start server and browser in a folder, press through a plan, and return what became of it."""
    from playwright.sync_api import sync_playwright

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = int(probe.getsockname()[1])
    # Longer than the walk: a recording that begins again gives no frame for a second or two.
    frames = round(PREVIEW_FPS * (plan.seconds + _MARGIN_S))
    server = Server(folder, record(folder / "walk.db3", frames, enlarged=4), port)
    with open_store(server.store) as store:
        store.save_round(WALK)
    server.start()
    try:
        server.wait()
        with sync_playwright() as driver:
            path = shutil.which("chromium") or shutil.which("chromium-browser")
            browser = driver.chromium.launch(executable_path=path, args=["--no-sandbox"])
            page = browser.new_page()
            page.set_default_timeout(1000 * _PATIENCE_S)
            page.goto(f"{server.address}/capture")
            page.locator("button.take:enabled").wait_for()
            page.wait_for_function("document.getElementById('color').naturalWidth > 0")
            page.wait_for_timeout(3000)
            outcome = walk(page, server, plan)
            browser.close()
            return outcome
    finally:
        server.kill()


def main() -> None:
    """Press, and print the counts."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=300.0)
    parser.add_argument("--gaps", type=int, default=3, help="losses of the connection, 20 s each")
    parser.add_argument("--kills", type=int, default=2, help="kills of the server")
    parser.add_argument("--folder", type=Path, help="where to work; a temporary one by default")
    asked = parser.parse_args()
    plan = Plan(asked.seconds, asked.gaps, asked.kills)
    folder = asked.folder or Path(tempfile.mkdtemp(prefix="presses-", dir=os.environ.get("TMPDIR")))
    folder.mkdir(parents=True, exist_ok=True)
    print(json.dumps(measure(folder, plan), indent=1))


if __name__ == "__main__":
    main()
