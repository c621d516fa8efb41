from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from cucumbervision.cli.console import summary_table
from cucumbervision.pipeline.detect import DetectedPicture, DetectResult

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
    assert table["no pictures, skipped"] == "1"
    assert "b.png: is not a readable picture" in done.stderr
    assert {p.name for p in out.iterdir()} == {
        "results.json",
        "images.json",
        "failures.csv",
        "overlays",
    }
    quiet = run("detect", photos / "a.png", *common, "--quiet", "--fast")
    assert (quiet.returncode, quiet.stdout, quiet.stderr) == (0, "", "")


def test_what_cannot_start_is_exit_code_2(run: Run, tmp_path: Path) -> None:
    done = run("detect", tmp_path, "--out", str(tmp_path / "out"))
    assert done.returncode == 2
    assert "there are no pictures" in done.stderr
    assert "Traceback" not in done.stderr


def test_the_summary_counts_pictures_without_fruit() -> None:
    scores = {"a": (0.9, 0.7), "b": (), "c": ()}
    pictures = [
        DetectedPicture(name, 64, 64, [{"score": score} for score in found])
        for name, found in scores.items()
    ]
    table = summary_table(DetectResult(pictures, models=[{"name": "x", "runtime": "y"}]))
    cells = dict(zip(*(list(column.cells) for column in table.columns), strict=True))
    assert cells == {
        "pictures": "3, 2 without fruit",
        "fruit": "2",
        "mean score": "0.80",
        "networks": "x on y",
    }
    empty = summary_table(DetectResult())
    assert list(empty.columns[1].cells)[2] == ""
