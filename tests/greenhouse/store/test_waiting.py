from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cucumbervision.capture.frames import Capture, Stop
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.errors import CaptureError, StoreError
from cucumbervision_greenhouse.store.records import key_of
from cucumbervision_greenhouse.store.waiting import MOST_TRIES, WaitingCaptures

CAMERA = Intrinsics(64, 48, 60.0, 60.0, 32.0, 24.0)
ROUND = key_of("round")


def capture(number: int = 0) -> Capture:
    depth = np.full((48, 64), 0.5 + 0.001 * number, np.float32)
    color = np.full((48, 64, 3), number, np.uint8)
    place = Stop("3", "left", 0.4 * number, number)
    return Capture(color, depth, CAMERA, f"c{number}", stop=place, source="camera 42")


def test_what_is_kept_comes_back_the_same_in_the_order_of_the_presses(tmp_path: Path) -> None:
    queue = WaitingCaptures(tmp_path / "house.waiting")
    for number in (2, 0, 1):
        queue.put(capture(number), key_of("stop", number), ROUND, 1_700_000_000.0 + number)
    back = WaitingCaptures(tmp_path / "house.waiting").captures()
    assert [one.key for one in back] == [key_of("stop", number) for number in range(3)]
    for number, one in enumerate(back):
        loaded, was = one.load(), capture(number)
        assert (loaded.depth_m == was.depth_m).all()
        assert (loaded.color == was.color).all()
        assert (loaded.stop, loaded.name, loaded.source) == (was.stop, was.name, was.source)
        assert one.stop == was.stop


def test_what_fails_again_and_again_is_set_aside_and_not_lost(tmp_path: Path) -> None:
    queue = WaitingCaptures(tmp_path)
    kept = queue.put(capture(), key_of("stop"), ROUND, 1_700_000_000.0)
    for _ in range(MOST_TRIES):
        assert [one.key for one in queue.captures()] == [kept.key]
        queue.begin(kept)
    assert queue.captures() == []
    assert queue.set_aside() == [replace(kept, tries=MOST_TRIES)]


@pytest.mark.parametrize(
    "description",
    [
        b"\xff",
        b"[" * 100_000,
        b"[]",
        b'{"stop": {"row": true}}',
        b'{"stop": {"row": "a\\u0000"}}',
        b'{"stop": {"place": 3}}',
        b'{"key": 7}',
        b'{"pressed_s": NaN}',
    ],
)
def test_a_damaged_description_does_not_hold_up_the_others(
    description: bytes, tmp_path: Path
) -> None:
    queue = WaitingCaptures(tmp_path)
    damaged = queue.put(capture(), key_of("first"), ROUND, 1_700_000_000.0)
    whole = queue.put(capture(1), key_of("second"), ROUND, 1_700_000_001.0)
    path = damaged.folder / "waiting.json"
    if description.startswith(b"{"):
        values = {**json.loads(path.read_text()), **json.loads(description)}
        description = json.dumps(values).encode()
    path.write_bytes(description)
    assert WaitingCaptures(tmp_path).captures() == [whole]
    assert damaged.folder.is_dir()


def test_a_full_or_closed_disk_leaves_nothing_half_done(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("no folder")
    with pytest.raises((StoreError, CaptureError), match="cannot be written"):
        WaitingCaptures(tmp_path / "file").put(capture(), key_of("stop"), ROUND, 1.0)


def test_no_acknowledged_capture_is_lost_when_the_program_is_killed(tmp_path: Path) -> None:
    script = (
        "import sys\n"
        "from pathlib import Path\n"
        "import numpy as np\n"
        "from cucumbervision.capture.frames import Capture\n"
        "from cucumbervision.capture.intrinsics import Intrinsics\n"
        "from cucumbervision_greenhouse.store.records import key_of\n"
        "from cucumbervision_greenhouse.store.waiting import WaitingCaptures\n"
        "queue = WaitingCaptures(Path(sys.argv[1]))\n"
        "depth, color = np.full((48, 64), 0.5, np.float32), np.zeros((48, 64, 3), np.uint8)\n"
        "one = Capture(color, depth, Intrinsics(64, 48, 60, 60, 32, 24), 'a')\n"
        "for n in range(100000):\n"
        "    print(queue.put(one, key_of('stop', n), key_of('round'), 1e9 + n).key, flush=True)\n"
    )
    folder = tmp_path / "house.waiting"
    for stop_after in (1, 4, 9):
        command = [sys.executable, "-c", script, str(folder)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as writer:
            assert writer.stdout is not None
            told = [writer.stdout.readline().strip() for _ in range(stop_after)]
            os.kill(writer.pid, signal.SIGKILL)
            told += [line.strip() for line in writer.stdout if line.endswith("\n")]
        queue = WaitingCaptures(folder)
        queue.clean()
        there = queue.captures()
        assert set(told) <= {one.key for one in there}
        for one in there:
            assert one.load().fill == 1.0
            queue.done(one)
        assert list(folder.iterdir()) == []
