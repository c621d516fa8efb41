from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

Run = Callable[..., subprocess.CompletedProcess[str]]


def test_detect_shows_a_summary_and_writes_its_files(
    run: Run, tmp_path: Path, one_box_detector: Path
) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    cv2.imwrite(str(photos / "a.png"), np.full((64, 64, 3), 90, np.uint8))
    (photos / "b.png").write_bytes(b"no picture")
    (photos / "c.txt").write_text("")
    out = tmp_path / "out"
    common = ("--instances", str(one_box_detector), "--segmenter", "none", "--out", str(out))
    done = run("detect", photos, *common)
    assert done.returncode == 1, done.stderr
    table = {line.split("│")[1].strip(): line.split("│")[2].strip()
             for line in done.stdout.splitlines() if line.startswith("│")}  # fmt: skip
    assert (table["pictures"], table["fruit"], table["mean score"]) == ("1", "1", "0.75")
    assert table["no images, skipped"] == "1"
    assert "b.png: is not a readable picture" in done.stderr
    written = {"results.json", "images.json", "failures.csv", "overlays"}
    assert {p.name for p in out.iterdir()} == written
    quiet = run("detect", photos / "a.png", *common, "--quiet", "--runtime", "fast")
    assert (quiet.returncode, quiet.stdout, quiet.stderr) == (0, "", "")
