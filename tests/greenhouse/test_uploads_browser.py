"""An upload goes on where it was cut: by a reload, by a kill of the server, by a full disk."""

from __future__ import annotations

import os
import re
import resource
import shutil
import subprocess
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("streamlit")

from cucumbervision.capture.source import example_captures
from cucumbervision_greenhouse.store.records import Round, key_of
from cucumbervision_greenhouse.store.repository import open_store

WALK = Round(key_of("sent"), "sent", "", 1_700_000_000.0, "long-cucumber")
PART = 4 * 2**20


class Parts:
    """The parts of files that a page sends: so many go through, then one is held."""

    def __init__(self, page: Any) -> None:
        self.page, self.left, self.offsets = page, 0, list[int]()
        self.held: list[Any] = []
        page.route(re.compile(r"/api/uploads/[^/]+/[0-9]+"), self._pass)

    def _pass(self, route: Any) -> None:
        self.offsets.append(int(route.request.url.split("offset=")[1]))
        if self.left > 0:
            self.left -= 1
            route.continue_()
        else:
            self.held.append(route)

    def wait_for_held(self) -> None:
        while not self.held:
            self.page.wait_for_timeout(100)


def test_an_upload_goes_on_after_a_reload_a_kill_and_a_fault_of_the_disk(
    tmp_path: Path, start_server: Callable[..., Any], new_page: Callable[..., Any]
) -> None:
    packed, store = tmp_path / "row.zip", tmp_path / "house.db"
    with zipfile.ZipFile(packed, "w") as archive:
        for path in sorted((example_captures() / "simulated-row-a").glob("*.*")):
            archive.write(path, f"row-a/{path.name}")
        archive.writestr("row-a/notes.txt", os.urandom(6 * PART))
    with open_store(store) as opened:
        opened.save_round(WALK)
    address = start_server(tmp_path, "--store", str(store), "--replay", str(example_captures()))
    page = new_page()
    parts = Parts(page)

    def send() -> None:
        page.goto(f"{address}/upload?round={WALK.key}")
        page.locator("input[type=file]").set_input_files(packed)
        page.get_by_role("button", name="Measure these files").click()

    # A recording is named before anything is sent, and costs the others nothing.
    page.goto(f"{address}/upload?round={WALK.key}")
    walk = {"name": "walk.BAG", "mimeType": "", "buffer": b"#ROSBAG V2.0"}
    notes = {"name": "notes.odt", "mimeType": "", "buffer": b"PK"}
    page.locator("input[type=file]").set_input_files([walk, notes])
    page.get_by_text("no part of a capture: notes.odt").wait_for()
    page.get_by_text("Recordings are not sent").and_(page.get_by_text("walk.BAG")).wait_for()
    assert page.get_by_role("button", name="Measure these files").is_disabled()

    parts.left = 2
    send()
    parts.wait_for_held()
    assert parts.offsets == [0, PART, 2 * PART]

    # A reload: the same file is chosen again, and only the rest is sent.
    parts.held.clear()
    parts.left, before = 1, len(parts.offsets)
    send()
    parts.wait_for_held()
    assert parts.offsets[before:] == [2 * PART, 3 * PART]

    # A kill of the server: the page waits for it, and goes on by itself.
    address.process.kill()
    address.process.wait()
    parts.left = 10**6
    parts.held.pop().continue_()
    page.get_by_text("sending goes on when it is back").wait_for()
    with (tmp_path / "server.log").open("ab") as log:
        server = subprocess.Popen(address.process.args, stdout=log, stderr=log, cwd=tmp_path)
    try:
        # No file can grow beyond a size; then it can again.
        unlimited = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.prlimit(server.pid, resource.RLIMIT_FSIZE, (5 * PART, unlimited[1]))
        page.get_by_text("File too large; check the disk").wait_for()
        resource.prlimit(server.pid, resource.RLIMIT_FSIZE, unlimited)
        page.get_by_text("1 capture saved").wait_for()
    finally:
        server.kill()
        server.wait()


def test_a_folder_is_chosen_whole_and_what_is_no_capture_is_named(
    tmp_path: Path, start_server: Callable[..., Any], new_page: Callable[..., Any]
) -> None:
    folder, store = tmp_path / "row", tmp_path / "house.db"
    shutil.copytree(example_captures() / "simulated-row-a", folder)
    (folder / "notes.odt").write_bytes(b"PK")
    with open_store(store) as opened:
        opened.save_round(WALK)
    address = start_server(tmp_path, "--store", str(store), "--replay", str(example_captures()))
    page = new_page()
    page.goto(f"{address}/upload?round={WALK.key}")
    with page.expect_file_chooser() as chooser:
        page.get_by_role("button", name="Choose a folder").click()
    chooser.value.set_files(folder)
    page.get_by_text("no part of a capture: row/notes.odt").wait_for()
    page.get_by_role("button", name="Measure these files").click()
    page.get_by_text("1 capture saved").wait_for()
