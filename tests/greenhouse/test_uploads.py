from __future__ import annotations

import errno
import io
import json
import math
import os
import re
import resource
import shutil
import subprocess
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from pydantic import ValidationError
from tests.greenhouse.conftest import measure_waiting

pytest.importorskip("streamlit")

from cucumbervision.capture.source import ReadOptions, example_captures
from cucumbervision.errors import CucumberVisionError, DiskFullError, StoreAwayError, UploadError
from cucumbervision.networks.registry import load_registry
from cucumbervision.run.options import MeasureOptions
from cucumbervision_greenhouse.measuring import SharedMeasurer
from cucumbervision_greenhouse.rounds.walking import DEMONSTRATION, NextPlace
from cucumbervision_greenhouse.store.records import Round, key_of
from cucumbervision_greenhouse.store.repository import Store, open_store
from cucumbervision_greenhouse.store.waiting import WaitingCaptures
from cucumbervision_greenhouse.uploads import CAMERAS, Sending, SentFile, UploadOutcome, Uploads

ROUND = key_of("uploads")
FILES = Sending(round=ROUND, files=(SentFile(name="a.zip", size=6), SentFile(name="b", size=0)))


def test_a_file_goes_on_where_it_ended_after_a_reload_and_a_restart(tmp_path: Path) -> None:
    uploads = Uploads(tmp_path / "up")
    assert uploads.begin(FILES, 10) == [0, 0]
    assert uploads.append(FILES.key, 0, 0, b"abc") == 3
    assert uploads.append(FILES.key, 0, 0, b"abc") == 3  # sent again: it is there
    assert uploads.append(FILES.key, 0, 5, b"f") == 3  # sent too early: not taken
    assert not uploads.is_whole(FILES.key)
    again = Uploads(tmp_path / "up")
    assert again.begin(FILES, 10) == [3, 0]
    assert again.whole() == []
    assert again.append(FILES.key, 0, 3, b"def") == 6
    assert again.whole() == [FILES.key]
    assert again._part(FILES.key, 0).read_bytes() == b"abcdef"


@pytest.mark.parametrize("damaged", [b"\xff", b"{", b"{}", b"[" * 100_000])
def test_a_damaged_upload_does_not_hold_up_the_others(damaged: bytes, tmp_path: Path) -> None:
    uploads = Uploads(tmp_path)
    other = FILES.model_copy(update={"camera": "x", "files": FILES.files[:1]})
    for sending in (FILES, other):
        uploads.begin(sending, 10)
    (tmp_path / FILES.key / "upload.json").write_bytes(damaged)
    assert [upload.sending for upload in uploads.all()] == [other]
    assert uploads.read(FILES.key) is None


def test_what_cannot_be_announced_leaves_no_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for odd in (math.nan, math.inf):
        with pytest.raises(ValidationError):
            SentFile(name="a.zip", size=6, changed=odd)

    def is_full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("cucumbervision_greenhouse.uploads.replace_text", is_full)
    with pytest.raises(OSError, match="No space"):
        Uploads(tmp_path / "up").begin(FILES, 10)
    assert Uploads(tmp_path / "up").all() == []


def test_a_file_is_named_with_its_folders() -> None:
    path = "house 7/" * 50 + "a.png"  # 405 characters, as a browser names the files of a folder
    assert SentFile(name=path, size=1).name == path
    with pytest.raises(ValidationError):
        SentFile(name="x" * 501, size=1)


def test_what_is_too_large_is_refused_before_it_is_sent(tmp_path: Path) -> None:
    uploads = Uploads(tmp_path / "up")
    with pytest.raises(UploadError, match="more than the 0 MB that are taken"):
        uploads.begin(FILES, 5)
    assert uploads.all() == []
    huge = Sending(round=ROUND, files=(SentFile(name="a.zip", size=10**18),))
    with pytest.raises(UploadError, match="the disk has room for"):
        uploads.begin(huge, 10**19)
    uploads.begin(FILES, 10)
    with pytest.raises(UploadError, match=r"a\.zip: is larger than it was"):
        uploads.append(FILES.key, 0, 0, b"seven b")
    for key, number in ((FILES.key, 2), (FILES.key, -1), (key_of("other"), 0)):
        with pytest.raises(UploadError, match="choose the files again"):
            uploads.append(key, number, 0, b"")


PLACE = NextPlace(row="7", side="right", position_m=3.0, step_m=0.5, back=True)
Send = Callable[..., tuple[UploadOutcome, ...]]


@pytest.fixture
def waiting(tmp_path: Path) -> WaitingCaptures:
    return WaitingCaptures(tmp_path / "waiting")


@pytest.fixture
def send(store: Store, waiting: WaitingCaptures, tmp_path: Path) -> Send:
    """Send files into the round, and return their outcomes."""
    store.save_round(Round(ROUND))
    uploads = Uploads(tmp_path / "uploads")

    def sent(files: list[tuple[str, io.BytesIO]], camera: str = "") -> tuple[UploadOutcome, ...]:
        listed = tuple(SentFile(name=name, size=len(f.getvalue())) for name, f in files)
        sending = Sending(round=ROUND, files=listed, place=PLACE, camera=camera)
        if sending.key not in uploads.whole():
            uploads.begin(sending, 10**9)
        for number, (_, content) in enumerate(files):
            uploads.append(sending.key, number, 0, content.getvalue())
        assert uploads.whole() == [sending.key]
        uploads.queue(sending.key, waiting, store, ReadOptions())
        assert uploads.whole() == []
        return uploads.all()[0].outcomes

    return sent


def pair(number: int) -> list[tuple[str, io.BytesIO]]:
    """Return a colour and a depth picture without intrinsics: a wall at 0.6 m."""
    return [
        (
            f"{part}_{number}.png",
            io.BytesIO(cv2.imencode(".png", np.full((48, 64), value, dtype))[1].tobytes()),
        )
        for part, value, dtype in (("color", 200 + number, np.uint8), ("depth", 600, np.uint16))
    ]


def packed() -> io.BytesIO:
    """Return a zip of two drawn captures without a position of their own."""
    file, folder = io.BytesIO(), example_captures() / "simulated-row-a"
    with zipfile.ZipFile(file, "w") as archive:
        for name in ("a", "b"):
            for path in sorted(p for p in folder.rglob("*") if p.is_file()):
                data = path.read_bytes()
                if path.name == "capture.json":
                    manifest = json.loads(data)
                    manifest["stop"] = {}
                    data = json.dumps(manifest).encode()
                archive.writestr(f"{name}/{path.relative_to(folder)}", data)
    file.seek(0)
    return file


def measure(store: Store, waiting: WaitingCaptures) -> None:
    options, measurer = MeasureOptions(instances="dataset"), SharedMeasurer(load_registry())
    measure_waiting(waiting, measurer, store, lambda: options)


def test_one_bad_file_costs_only_itself_and_each_is_told_by_its_name(
    store: Store, waiting: WaitingCaptures, send: Send
) -> None:
    files = [("odd.png", io.BytesIO(b"MZ")), *pair(1), ("row.zip", packed())]
    told = send(files)
    assert sum(one.saved for one in told) == 2
    lost = [one for one in told if not one.saved]
    assert [one.name for one in lost] == ["odd.png", "upload"]
    assert "has no matching picture" in lost[0].words
    assert "intrinsics" in lost[1].words
    again = [("is in the round already", False)] * 2
    assert [(one.words, one.saved) for one in send([("row.zip", packed())])] == again
    measure(store, waiting)
    # Drawn: in the demonstration, from the given place on, backwards.
    assert store.stops(ROUND) == []
    places = [(s.row, s.side, s.position_m, s.step) for s in store.stops(DEMONSTRATION)]
    assert places == [("7", "right", 3.0, 1), ("7", "right", 2.5, 2)]
    assert [(one.words, one.saved) for one in send([("row.zip", packed())])] == again
    store.delete_stop(store.stops(DEMONSTRATION)[0].key)
    assert [one.words for one in send([("row.zip", packed())])] == [
        "was deleted: undo that to have it back",
        "is in the round already",
    ]


def test_one_camera_takes_a_place_once(store: Store, waiting: WaitingCaptures, send: Send) -> None:
    camera = next(iter(CAMERAS))
    (told,) = send(pair(1), camera=camera)
    assert (told.saved, told.words) == (True, "saved (row 7, right, 3.00 m)")
    (told,) = send(pair(2), camera=camera)
    assert not told.saved
    measure(store, waiting)
    (told,) = send(pair(3), camera=camera)
    assert "stop 1 is at 3.00 m of that row and side" in told.words
    (stop,) = store.stops(ROUND)
    # A camera's usual figures stand for intrinsics that are missing.
    assert store.stop(stop.key).captures[0].camera["fx"] == pytest.approx(CAMERAS[camera] * 48)


@pytest.mark.parametrize("error", [DiskFullError("no space left"), StoreAwayError("is locked")])
def test_files_stay_while_the_disk_is_full_or_the_store_away(
    error: CucumberVisionError, send: Send, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise error

    with monkeypatch.context() as patch:
        patch.setattr(WaitingCaptures, "put", fail)
        with pytest.raises(type(error)):
            send([("row.zip", packed())])
    assert [outcome.saved for outcome in send([("row.zip", packed())])] == [True, True]


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


def test_a_folder_is_sent_and_a_file_goes_on_after_a_reload_a_kill_and_a_fault_of_the_disk(
    tmp_path: Path, start_server: Callable[..., Any], new_page: Callable[..., Any]
) -> None:
    packed, store, folder = tmp_path / "row.zip", tmp_path / "house.db", tmp_path / "row"
    shutil.copytree(example_captures() / "simulated-row-b", folder)
    (folder / "notes.odt").write_bytes(b"PK")
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

    # A folder is chosen whole; what is no capture is named before anything is sent.
    page.goto(f"{address}/upload?round={WALK.key}")
    with page.expect_file_chooser() as chooser:
        page.get_by_role("button", name="Choose a folder").click()
    chooser.value.set_files(folder)
    page.get_by_text("no part of a capture: row/notes.odt").wait_for()
    parts.left = 10**6
    page.get_by_role("button", name="Measure these files").click()
    page.get_by_text("1 capture saved").wait_for()
    parts.offsets.clear()
    page.goto(f"{address}/upload?round={WALK.key}")
    walk = {"name": "walk.BAG", "mimeType": "", "buffer": b"#ROSBAG V2.0"}
    page.locator("input[type=file]").set_input_files([walk])
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
