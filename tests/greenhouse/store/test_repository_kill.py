from __future__ import annotations

import subprocess
import sys
from pathlib import Path

SCRIPT = "tests.robustness.kill_stops"


def test_a_program_killed_again_and_again_loses_and_doubles_nothing(
    address: str, tmp_path: Path
) -> None:
    options = ["--url", address, "--images", str(tmp_path / "pictures")]
    options += ["--stops", "24", "--kills", "3"]
    done = subprocess.run(
        [sys.executable, "-m", SCRIPT, *options],
        capture_output=True,
        text=True,
        check=False,
        timeout=240,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert " stops: none lost, none doubled" in done.stdout
    killed = int(done.stdout.split("killed ")[1].split(",")[0])
    assert killed >= 3
