"""Processor time of a capture beyond the networks."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from statistics import median

from figures import Figure

from cucumbervision.capture.frames import Capture
from cucumbervision.capture.source import example_captures
from cucumbervision.run.folder import OutputFolder
from cucumbervision.run.inputs import Listed, list_captures
from cucumbervision.run.measurer import Measurer
from cucumbervision.run.whole_run import FolderWorker
from cucumbervision.stream import fruit_stream as streaming
from cucumbervision.stream.fruit_stream import FruitStream
from speeds.frames import MODELS, overlapped
from speeds.stages import StageClock, by_stage, stage_ms


def processor(quick: bool) -> list[Figure]:
    """Compare the processor time of a capture beyond its networks with that within them."""
    rounds = 2 if quick else 9
    captures = list_captures([example_captures()], MODELS.reading)
    listed = [entry for entry in captures if isinstance(entry, Listed)]
    clock, stream = StageClock(), FruitStream.fast(MODELS)
    frames = [entry.ref.load() for entry in listed]
    with tempfile.TemporaryDirectory() as tmp:
        worker = FolderWorker(Measurer(MODELS), OutputFolder(Path(tmp)))
        tasks = [partial(worker, entry) for entry in listed]
        of_capture = stage_ms(clock, tasks, rounds)
    of_frame = stage_ms(clock, [partial(stream.take, frame) for frame in frames], rounds)
    stages = by_stage("measure", of_capture) + by_stage("stream --fast", of_frame)
    return stages + overlap_gains(stream, frames, rounds)


def overlap_gains(stream: FruitStream, captures: Sequence[Capture], rounds: int) -> list[Figure]:
    """Compare frames that are searched while one is measured with frames in turn, by the clock."""
    pairs: dict[int, list[tuple[float, float]]] = {
        fewest_cores: [] for fewest_cores in (1, sys.maxsize)
    }
    for _ in range(rounds):
        for fewest_cores, turns in pairs.items():
            streaming._FEWEST_CORES = fewest_cores
            turns.append(overlapped(stream, captures, 3))
    (rates, lags_s), (rates_alone, lags_alone_s) = (zip(*t, strict=True) for t in pairs.values())
    return [
        Figure(
            "stream --fast: frames a second, searched ahead, times in turn",
            median(rates) / median(rates_alone),
            "x",
        ),
        Figure(
            "stream --fast: from a frame to its line, searched ahead, times in turn",
            median(lags_s) / median(lags_alone_s),
            "x",
        ),
    ]
