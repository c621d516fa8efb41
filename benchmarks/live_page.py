"""What it costs the program that somebody looks at the camera's picture.

    python benchmarks/live_page.py [--seconds 60] [--viewers 2]

The dashboard is served with the bundled captures as its camera, and that many pages of a Chromium
show them. Printed are the server's processor time in the first minute, in which it loads the
networks and measures those captures, the share of a processor that it uses from then on, and its
memory. Then the same where all memory is looked through for garbage after each run of a page, as
Streamlit does unless it is told otherwise.
"""

from __future__ import annotations

import argparse
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from hammer import FLAGS, answers
from playwright.sync_api import Browser, sync_playwright

from cucumbervision.capture.source import bundled_captures
from cucumbervision.dashboard.server import REPLAY_VARIABLE, STORE_VARIABLE, server_arguments

BEGUN_S = 60.0  # networks are loaded and the bundled captures measured meanwhile
OPTION = "--runner.postScriptGC="


def served(store: Path, *, collects: bool) -> tuple[subprocess.Popen[bytes], str]:
    """Start the server, and return it with its address once it answers."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = int(probe.getsockname()[1])
    given = server_arguments("127.0.0.1", port, browser=False)
    given = [f"{OPTION}{str(collects).lower()}" if x.startswith(OPTION) else x for x in given]
    named = {STORE_VARIABLE: str(store), REPLAY_VARIABLE: str(bundled_captures())}
    server = subprocess.Popen(
        [sys.executable, "-m", "streamlit", *given],
        cwd=store.parent,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env={**os.environ, **named},
    )
    address = f"http://127.0.0.1:{port}"
    if not answers(server, address):
        raise SystemExit("the server ended")
    return server, address


def processor_s(pid: int) -> float:
    """Return the processor time of a process, seconds."""
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def share(pid: int, seconds: float) -> float:
    """Return the share of a processor that a process uses for some seconds."""
    begun, begun_s = processor_s(pid), time.perf_counter()
    time.sleep(seconds)
    return (processor_s(pid) - begun) / (time.perf_counter() - begun_s)


def look(browser: Browser, viewers: int, seconds: float, *, collects: bool) -> str:
    """Show the camera's picture for so long, and return what that took of the server."""
    with tempfile.TemporaryDirectory() as folder:
        server, address = served(Path(folder) / "house.db", collects=collects)
        try:
            pages = [browser.new_page() for _ in range(viewers)]
            for page in pages:
                page.goto(f"{address}/capture")
            begun = processor_s(server.pid)
            time.sleep(BEGUN_S)
            first_s = processor_s(server.pid) - begun
            for page in pages:
                page.locator("svg.view image").first.wait_for()
            used = share(server.pid, seconds)
            held = int(Path(f"/proc/{server.pid}/statm").read_text(encoding="ascii").split()[1])
            for page in pages:
                page.close()
        finally:
            server.terminate()
            server.wait(60)
    megabytes = held * os.sysconf("SC_PAGE_SIZE") / 1e6
    return (
        f"{first_s:.0f} s of a processor in the first {BEGUN_S:.0f} s, "
        f"then {100 * used:.0f} % of one, {megabytes:.0f} MB"
    )


def main() -> None:
    """Look as shipped, and with collections."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--viewers", type=int, default=2)
    given = parser.parse_args()
    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=chromium, args=list(FLAGS))
        for name, collects in (("as shipped", False), ("with collections", True)):
            told = look(browser, given.viewers, given.seconds, collects=collects)
            print(f"{given.viewers} viewers, {name}: {told}", flush=True)
        browser.close()


if __name__ == "__main__":
    main()
