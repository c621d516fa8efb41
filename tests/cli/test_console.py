from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from cucumbervision.accuracy.statistics import ReportTable
from cucumbervision.capture.readers import open_source
from cucumbervision.capture.readers.native import write_native
from cucumbervision.capture.source import example_captures
from cucumbervision.cli.console import (
    plain_console,
    print_table,
    screen,
    show_failures,
    stopping_gently,
    summary_table,
)
from cucumbervision.run.detect import DetectedPicture, DetectResult
from cucumbervision.run.measurer import Failure

Run = Callable[..., subprocess.CompletedProcess[str]]


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


def lines_of(text: str) -> list[list[str]]:
    """Cells of the rows of a printed table."""
    rows = [line for line in text.splitlines() if line.startswith("│")]
    return [[cell.strip() for cell in row.strip("│").split("│")] for row in rows]


def test_each_fruit_is_a_line_with_its_length_and_why(run: Run, tmp_path: Path) -> None:
    capture = next(iter(open_source(example_captures() / "simulated-bench"))).load()
    # About the second fruit the camera reads no depth.
    around = cv2.dilate(capture.masks[1].astype(np.uint8), np.ones((41, 41), np.uint8)) > 0
    depth_m = np.where(around, np.float32(0), capture.depth_m)
    write_native(replace(capture, name="half-dark", depth_m=depth_m), tmp_path / "in")
    done = run("measure", tmp_path / "in", "--out", tmp_path / "out", "--methods", "m1,m6")
    assert done.returncode == 0, done.stderr
    first, second, third = lines_of(done.stdout)
    assert (first[0], [row[1] for row in (first, second, third)]) == ("half-dark", ["1", "2", "3"])
    assert (second[2], second[3]) == ("", "")
    assert "not measured: " in second[-1]
    low, high = (float(text) for text in first[3].split("–"))
    assert low < float(first[2].removeprefix("≥")) < high
    # M1 and M6 each have a column, because they were asked for.
    assert len(first) == 7
    assert "2 of 3 fruit measured in 1 captures" in done.stdout
    assert "some of these captures are simulated" in done.stdout


def test_names_are_printed_as_they_are(capsys: pytest.CaptureFixture[str]) -> None:
    table = ReportTable.of("[b]rows[/b]", ["row", "MAPE (%):.1"], [["[i]", 2.25]], "[all] :ok:")
    console = plain_console()
    console.print("[red]house[/red] :tomato:")
    show_failures([Failure("a", "", "CaptureError", "[a]: does not exist")])
    told = capsys.readouterr()
    assert told.out == "[red]house[/red] :tomato:\n"
    assert told.err == "1 failed:\n  [a]: does not exist\n"
    print_table(screen(), table)
    printed = capsys.readouterr().out
    assert printed.startswith("[b]rows[/b]")
    assert printed.endswith("[all] :ok:\n")
    assert lines_of(printed) == [["[i]", "2.2"]]


def test_failures_say_where_their_table_is(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    show_failures([], tmp_path)
    assert capsys.readouterr().err == ""
    failures = [Failure(name, "", "CaptureError", f"{name}: is damaged") for name in ("a", "b")]
    (tmp_path / "failures.csv").write_text("")
    show_failures(failures, tmp_path)
    expected = f"2 failed, also in {tmp_path}/failures.csv:\n  a: is damaged\n  b: is damaged\n"
    assert capsys.readouterr().err == expected


def test_the_first_ctrl_c_asks_and_the_second_interrupts(
    capsys: pytest.CaptureFixture[str],
) -> None:
    # A shell that starts the tests in the background has them ignore Ctrl-C.
    outside = signal.signal(signal.SIGINT, signal.default_int_handler)
    before = signal.getsignal(signal.SIGINT)
    with stopping_gently() as is_cancelled:
        assert not is_cancelled()
        os.kill(os.getpid(), signal.SIGINT)
        assert is_cancelled()
        assert "press Ctrl-C again to stop immediately" in capsys.readouterr().err
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is before
    signal.signal(signal.SIGINT, outside)
