"""What a frame of a stream costs beside its networks: `cucumbervision stream --fast` and without.

    python benchmarks/bench_stream.py [--frames 40] [--runtime openvino] [--sam]

A bundled capture of three fruit moves by 12 pixels a frame. Printed are medians a frame: time, time
of the processor (all threads together), both
inside the networks' own calls and in all, and the ratio of the two.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from statistics import median

import numpy as np
from bench_frame import NetworkClock

from cucumbervision.capture.frames import Capture
from cucumbervision.capture.readers import open_source
from cucumbervision.capture.source import bundled_captures
from cucumbervision.pipeline.measurer import Measurer
from cucumbervision.pipeline.options import MeasureOptions
from cucumbervision.streaming.stream import FruitStream

FPS = 15
STEP_PX = 12


def walk(frames: int) -> list[Capture]:
    """Return frames of a camera that walks to and fro before three fruit."""
    one = next(iter(open_source(bundled_captures() / "simulated-row-a"))).load()
    moved = []
    for k in range(frames):
        shift = -STEP_PX * abs((k + 8) % 16 - 8)
        color, depth_m = np.roll(one.color, shift, 1), np.roll(one.depth_m, shift, 1)
        stamp = 1e9 + k / FPS
        moved.append(replace(one, color=color, depth_m=depth_m, masks=(), timestamp_s=stamp))
    return moved


def main() -> None:
    """Stream the frames and print the medians."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--runtime", default="auto")
    parser.add_argument("--sam", action="store_true", help="the full stream in place of --fast")
    arguments = parser.parse_args()
    clock = NetworkClock()
    options = MeasureOptions(instances="models", runtime=arguments.runtime)
    stream = FruitStream(Measurer(options)) if arguments.sam else FruitStream.fast(options)
    lines: list[tuple[float, ...]] = []
    found = 0
    for k, capture in enumerate(walk(arguments.frames + 5)):
        clock.start()
        start, busy = time.perf_counter(), time.process_time()
        frame = stream.take(capture)
        frame.as_json()
        whole = time.perf_counter() - start, time.process_time() - busy
        inside = sum(clock.seconds.values()), sum(clock.processor_seconds.values())
        if k >= 5:
            lines.append((*whole, *inside, whole[0] / inside[0], whole[1] / inside[1]))
            found += len(frame.fruit)
    print(", ".join(f"{m['name']} on {m['runtime']}" for m in stream.measurer.models))
    print(f"{len(lines)} frames of 848x480, {found / len(lines):.1f} fruit a frame")
    time_ms, busy_ms, inside_ms, inside_busy_ms, ratio, busy_ratio = (
        median(column) for column in zip(*lines, strict=True)
    )
    print(f"{'':30} {'time':>9} {'processor':>10}")
    print(f"{'frame, ms':30} {1e3 * time_ms:9.1f} {1e3 * busy_ms:10.1f}")
    print(f"{'in the networks, ms':30} {1e3 * inside_ms:9.1f} {1e3 * inside_busy_ms:10.1f}")
    print(f"{'frame / networks':30} {ratio:9.2f} {busy_ratio:10.2f}")
    alone = busy_ms - inside_busy_ms / 2
    print(f"{1 / time_ms:.1f} frames/s now, whatever else the machine does")
    print(f"{1 / alone:.1f} by the processor's time: networks on two idle cores, the rest on one")


if __name__ == "__main__":
    main()
