"""What the hour's stream calls a leak, and that it waits for a slow machine."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from tests.robustness import hour
from tests.robustness.hour import Look, faults_of

SLOW = """
import json, sys, time
from pathlib import Path
said = []
while True:
    for path in sorted(Path(sys.argv[1]).iterdir()):
        if path.name not in said:
            line = {"capture": path.name, "latency_s": 0.1, "fruit": [{"track": 1}]}
            print(json.dumps(line), flush=True)
            said.append(path.name)
            break
    time.sleep(4 if len(said) == 1 else 0.1)
"""


@pytest.mark.parametrize(
    ("memory_mb", "is_leak"),
    [
        (lambda minute: 164 + min(minute, 20) / 2, False),  # a warm-up
        (lambda minute: 164 + minute / 4, True),
        (lambda minute: 164 if minute < 20 else 210, True),
    ],
)
def test_a_leak_goes_on_and_a_warm_up_ends(
    memory_mb: Callable[[int], float], is_leak: bool
) -> None:
    looks = [Look(memory_mb(minute), files=9, threads=3, busy_s=1.0) for minute in range(60)]
    assert bool(faults_of(looks)) is is_leak


def test_what_a_slow_stream_has_not_come_to_is_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def begin(_: str, house: Path, *__: object, **___: object) -> subprocess.Popen[Any]:
        return subprocess.Popen(
            [sys.executable, "-c", SLOW, str(house)],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )

    monkeypatch.setattr(hour, "begin", begin)
    monkeypatch.setattr(hour, "_MINUTE_S", 5.0)
    monkeypatch.setattr(hour, "_HELD", 2)
    monkeypatch.setattr(hour, "_DAMAGED", 10**6)
    faults, _ = hour.stream_for(tmp_path, 1, 0.02, "dataset")
    assert faults == ["too few looks"]
