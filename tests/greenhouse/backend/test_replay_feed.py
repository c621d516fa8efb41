from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from tests.greenhouse.backend.test_camera_feed import wait_for

from cucumbervision.capture.frames import Stop
from cucumbervision.capture.source import example_captures
from cucumbervision.errors import CaptureError
from cucumbervision_greenhouse.backend.replay_feed import Replay


def test_a_replay_shows_what_it_takes_and_begins_again_at_its_end() -> None:
    replay = Replay(example_captures())
    names = []
    for _ in range(4):
        shown = wait_for(replay, "replay")
        assert shown.capture is not None
        assert shown.quality is not None
        taken = replay.take(5, Stop("7", "left", 1.5, 3))
        assert taken.name == shown.capture.name
        assert taken.stop == Stop("7", "left", 1.5, 3)
        names.append(taken.name)
    assert names == ["simulated-bench", "simulated-row-a", "simulated-row-b", "simulated-bench"]


def test_a_replay_with_nothing_readable_says_so(tmp_path: Path) -> None:
    broken = tmp_path / "one"
    broken.mkdir()
    (broken / "capture.json").write_text("{")
    replay = Replay(tmp_path)
    assert "capture.json" in wait_for(replay, "absent").message
    with pytest.raises(CaptureError, match=r"capture\.json"):
        replay.take(1, Stop())


def test_many_who_take_at_once_each_get_the_next_capture() -> None:
    replay = Replay(example_captures())
    with ThreadPoolExecutor(8) as hands:
        taken = list(hands.map(lambda _: replay.take(1, Stop()).name, range(24)))
    wait_for(replay, "replay")
    assert {name: taken.count(name) for name in taken} == {
        "simulated-bench": 8,
        "simulated-row-a": 8,
        "simulated-row-b": 8,
    }


def test_presses_and_takers_at_once_never_read_the_folder_in_two_threads() -> None:
    replay = Replay(example_captures())
    wait_for(replay, "replay")
    with ThreadPoolExecutor(8) as hands:
        grabbed = list(hands.map(lambda _: replay.grab(1, time.time() + 1).capture(), range(24)))
    names = [one.name for one in grabbed]
    assert {name: names.count(name) for name in names} == {
        "simulated-bench": 8,
        "simulated-row-a": 8,
        "simulated-row-b": 8,
    }
