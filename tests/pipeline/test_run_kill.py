from __future__ import annotations

import subprocess
import sys

SCRIPT = "tests.robustness.kill_batch"


def test_a_batch_killed_again_and_again_loses_and_doubles_nothing() -> None:
    done = subprocess.run(
        [sys.executable, "-m", SCRIPT, "--kills", "6", "--captures", "8"],
        capture_output=True,
        text=True,
        check=False,
        timeout=500,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "6 kills: nothing lost, nothing doubled" in done.stdout
    assert "killed inside a write" in done.stdout
