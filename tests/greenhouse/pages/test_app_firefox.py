"""Firefox, by its own WebDriver BiDi, walks from a press to the map."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("streamlit")
pytest.importorskip("websockets")

from websockets.sync.client import ClientConnection, connect

from cucumbervision.capture.source import example_captures
from cucumbervision_greenhouse.store.repository import open_store

FIREFOX = shutil.which("firefox-esr") or shutil.which("firefox")
PATIENCE_S = 300.0

pytestmark = [
    pytest.mark.timeout(1800),
    pytest.mark.xdist_group("browser"),
    pytest.mark.skipif(FIREFOX is None, reason="Firefox is not installed"),
]

# What Streamlit's components draw lies in shadow roots.
FIND = """(selector) => {
  const every = (root) => [root, ...[...root.querySelectorAll('*')].flatMap(
    (node) => (node.shadowRoot ? every(node.shadowRoot) : []))];
  for (const root of every(document)) {
    const found = root.querySelector(selector);
    if (found) return found;
  }
  return null;
}"""


class Firefox:
    """A page of Firefox, and what its console said."""

    def __init__(self, line: ClientConnection) -> None:
        self.said: list[str] = []
        self._number, self._line = 0, line
        self.ask("session.new", capabilities={})
        self.ask("session.subscribe", events=["log.entryAdded"])
        self._page = self.ask("browsingContext.getTree")["contexts"][0]["context"]

    def ask(self, method: str, **what: Any) -> Any:
        """Send a command; return its result."""
        self._number += 1
        self._line.send(json.dumps({"id": self._number, "method": method, "params": what}))
        while True:
            heard = json.loads(self._line.recv(PATIENCE_S))
            if heard.get("method") == "log.entryAdded" and heard["params"]["level"] == "error":
                self.said.append(str(heard["params"]["text"]))
            if heard.get("id") == self._number:
                assert heard["type"] == "success", heard
                return heard["result"]

    def go(self, address: str) -> None:
        """Open an address."""
        self.ask("browsingContext.navigate", context=self._page, url=address, wait="complete")

    def evaluate(self, script: str) -> Any:
        """Return what an expression is; plain values only."""
        target = {"context": self._page}
        found = self.ask("script.evaluate", expression=script, target=target, awaitPromise=True)
        return found["result"].get("value")

    def wait_for(self, selector: str, holds: str = "true") -> None:
        """Wait until an element is there and an expression of it, `node`, holds."""
        until = time.monotonic() + PATIENCE_S
        ask = f"((node) => Boolean(node && ({holds})))(({FIND})({json.dumps(selector)}))"
        while not self.evaluate(ask):
            assert time.monotonic() < until, f"{selector}: {holds}"
            time.sleep(0.3)

    def tap(self, selector: str) -> None:
        """Press the mouse's button on an element, where it is on the screen."""
        self.wait_for(selector)
        before, now = "", self._middle(selector)
        while before != now:  # the page is still being drawn
            time.sleep(1.0)
            before, now = now, self._middle(selector)
        x, y = (round(value) for value in json.loads(now))
        acts = [
            {"type": "pointerMove", "x": x, "y": y},
            {"type": "pointerDown", "button": 0},
            {"type": "pointerUp", "button": 0},
        ]
        mouse = {"type": "pointer", "id": "mouse", "actions": acts}
        self.ask("input.performActions", context=self._page, actions=[mouse])

    def _middle(self, selector: str) -> str:
        return str(
            self.evaluate(
                f"((node) => {{ node.scrollIntoView({{block: 'center'}});"
                "const box = node.getBoundingClientRect();"
                "return JSON.stringify([box.x + box.width / 2, box.y + box.height / 2]); })"
                f"(({FIND})({json.dumps(selector)}))"
            )
        )


def _address(log: Path) -> str:
    """Wait until Firefox says where it listens."""
    until = time.monotonic() + PATIENCE_S
    while (told := re.search(r"BiDi listening on (ws://\S+)", log.read_text())) is None:
        assert time.monotonic() < until, log.read_text()
        time.sleep(0.2)
    return f"{told[1]}/session"


@pytest.fixture
def firefox(tmp_path: Path) -> Iterator[Firefox]:
    folder = tmp_path / "profile"
    folder.mkdir()
    with (folder / "firefox.log").open("wb") as log:
        command = [str(FIREFOX), "--headless", "--no-remote", "--profile", str(folder)]
        process = subprocess.Popen(
            [*command, "--remote-debugging-port", "0"], stdout=log, stderr=log
        )
    try:
        with connect(_address(folder / "firefox.log"), max_size=None) as line:
            yield Firefox(line)
    finally:
        process.terminate()
        process.wait(PATIENCE_S)


def test_firefox_presses_reads_results_and_taps_the_map(
    house: Path, tmp_path: Path, firefox: Firefox, start_server: Callable[..., Any]
) -> None:
    address = start_server(tmp_path, "--store", str(house), "--replay", str(example_captures()))
    with open_store(house) as store:
        walk = store.rounds()[0].key
    firefox.go(f"{address}/capture?round={walk}")
    firefox.wait_for("#color", "node.naturalWidth > 0")
    firefox.tap("button.take:enabled")
    firefox.wait_for("#where", "node.textContent.includes('saved')")
    firefox.wait_for("svg.view")

    firefox.go(f"{address}/results?round={walk}")
    firefox.tap(".fruit button")
    firefox.wait_for("svg.view polygon")

    firefox.go(f"{address}/map?round={walk}")
    firefox.tap("svg.map path")
    firefox.wait_for(".card img", "node.src && !node.hidden")
    assert firefox.said == []
