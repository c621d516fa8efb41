"""The whole pipeline beside its networks alone."""

from __future__ import annotations

import time
from dataclasses import replace
from statistics import median

from figures import Figure

from cucumbervision.run.batch import in_process
from cucumbervision.run.measurer import Measurer
from speeds.frames import MODELS, bundled, five_fruit, pace
from speeds.stages import StageClock


def pipeline(quick: bool) -> list[Figure]:
    """Compare the whole pipeline with its networks' own times, when nothing runs beside them."""
    count, clock = 9 if quick else 30, StageClock(time.perf_counter)
    captures, alone = bundled(), Measurer(MODELS)

    def networks_s() -> float:
        clock.start()
        for capture in captures:
            alone.detect(capture)
        return clock.taken_s["networks"] / len(captures)

    networks_s()
    # Before and after, since a shared machine changes its mind.
    before_s = median(networks_s() for _ in range(count // 6))
    whole_s = pace(MODELS, in_process, count, 5)
    own_s = (before_s + median(networks_s() for _ in range(count // 6))) / 2
    one_size_s = pace(replace(MODELS, input_sizes=(640,)), in_process, count, 5)
    return [
        five_fruit_figure(alone, count),
        Figure("a capture in the networks alone", 1e3 * own_s, "ms"),
        Figure("a capture, read to saved", 1e3 * whole_s, "ms"),
        Figure("the same, times one at the input size 640", whole_s / one_size_s, "x"),
        Figure("pipeline beyond its networks", 100 * (whole_s - own_s) / own_s, "%", "<= 8"),
    ]


def five_fruit_figure(measurer: Measurer, rounds: int) -> Figure:
    """Time a frame with five fruit in memory, by all networks and with their lengths."""
    frame, taken_s = five_fruit(), []
    for _ in range(rounds):
        begun = time.perf_counter()
        fruit = measurer.measure(frame).fruit
        taken_s.append(time.perf_counter() - begun)
    name = f"a frame in memory with {len(fruit)} fruit, all networks"
    return Figure(name, 1e3 * median(taken_s), "ms", "<= 300")
