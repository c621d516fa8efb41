"""Figures beside their aims, captures to time with, and the pace of a batch and of a stream."""

from __future__ import annotations

import os
import re
import shutil
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median

from cucumbervision.capture.frames import Capture
from cucumbervision.capture.readers import open_source
from cucumbervision.capture.source import example_captures
from cucumbervision.run.batch import Engine
from cucumbervision.run.measurer import Failure
from cucumbervision.run.options import MeasureOptions
from cucumbervision.run.whole_run import BatchOptions, measure_inputs
from cucumbervision.stream.fruit_stream import FruitStream, in_order

MODELS = MeasureOptions(instances="models")
GIVEN = MeasureOptions(instances="dataset", segmenter="none")

HEAD = "| what | figure | aim |\n|---|--:|---|"


@dataclass(frozen=True)
class Figure:
    """One line of a table: what, how much, and what it should be ('<= 8' or '>= 1.7')."""

    what: str
    value: float
    unit: str
    aim: str = ""

    @property
    def kept(self) -> bool:
        """Whether the aim, if there is one, is reached."""
        if not self.aim:
            return True
        sign, limit = self.aim.split()
        return self.value <= float(limit) if sign == "<=" else self.value >= float(limit)

    @property
    def verdict(self) -> str:
        """The aim in words."""
        return f"{self.aim}: {'kept' if self.kept else 'MISSED'}" if self.aim else ""


def machine() -> str:
    """Return what this ran on."""
    names = re.findall(r"model name\s*: (.*)", Path("/proc/cpuinfo").read_text(encoding="utf-8"))
    load = os.getloadavg()[0]
    return f"{len(os.sched_getaffinity(0))} cores, {names[0]}; load {load:.1f}"


def as_row(figure: Figure) -> str:
    """Return a figure as a line of a Markdown table."""
    return f"| {figure.what} | {figure.value:.3g} {figure.unit} | {figure.verdict} |"


def bundled() -> list[Capture]:
    """Return the bundled captures, with 2.7 fruit on average."""
    return [ref.load() for ref in open_source(example_captures())]


def five_fruit() -> Capture:
    """Return a frame with the three fruit of a bundled capture and, beside them, two of another."""
    row_a, row_b = (capture for capture in bundled() if "row" in capture.name)
    color, depth_m = row_a.color.copy(), row_a.depth_m.copy()
    for place, columns in ((0, slice(188, 368)), (505, slice(505, 600))):  # where none are
        width = columns.stop - columns.start
        color[:, place : place + width] = row_b.color[:, columns]
        depth_m[:, place : place + width] = row_b.depth_m[:, columns]
    return replace(row_a, color=color, depth_m=depth_m, masks=(), name="five-fruit")


def copies(folder: Path, count: int) -> Path:
    """Lay out the bundled captures again and again, each under a name of its own."""
    folder.mkdir()
    sources = sorted(p for p in example_captures().iterdir() if p.is_dir())
    for k in range(count):
        source = sources[k % len(sources)]
        shutil.copytree(source, folder / f"c{k:03d}")
    return folder


def pace(
    options: MeasureOptions,
    engine: Engine,
    count: int,
    skip: int,
    clock: Callable[[], float] = time.perf_counter,
) -> float:
    """Return seconds a capture, after the first few, of a whole batch as the command does it."""
    at: list[float] = []
    with tempfile.TemporaryDirectory() as tmp:
        house = copies(Path(tmp) / "house", count)
        batch = BatchOptions(engine=engine)
        result = measure_inputs(
            [house], Path(tmp) / "out", options, lambda _: at.append(clock()), batch
        )
    if result.failures or len(at) != count:
        raise SystemExit(f"{len(result.failures)} failures: {result.failures[:1]}")
    return (at[-1] - at[skip - 1]) / (count - skip)


def overlapped(
    stream: FruitStream, captures: Sequence[Capture], rounds: int
) -> tuple[float, float]:
    """Return frames a second of a whole stream, as the command runs it, and the median latency."""
    times_s, latencies_s = [], []
    for frame in stream.follow(in_order(rounds * list(captures))):
        if isinstance(frame, Failure):
            raise SystemExit(frame.message)
        times_s.append(time.perf_counter())
        latencies_s.append(frame.latency_s)
    count = len(captures)
    rate = (len(times_s) - count) / (times_s[-1] - times_s[count - 1])
    return rate, median(latencies_s[count:])
