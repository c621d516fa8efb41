"""What a whole frame costs beside its networks, and whether memory stays flat.

    python benchmarks/bench_frame.py [--frames 500] [--runtime auto] [--detector YOLO.onnx]

Measures the bundled captures over and over: MobileSAM prompted by the masks' boxes (and a YOLO
export before it, if one is named), all methods, rows. Time inside the networks is taken at the
runtime's own call; the rest of the frame is ours. Peak memory is the process's.
"""

from __future__ import annotations

import argparse
import resource
import time
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any

from cucumbervision.capture.readers import open_source
from cucumbervision.perception import runtime as runtimes
from cucumbervision.session.finders import make_finder
from cucumbervision.session.options import MeasureOptions
from cucumbervision.session.rows import fruit_row
from cucumbervision.session.run import measure_capture
from cucumbervision.synthesis.demo import bundled_captures


class NetworkClock:
    """Adds up the time inside the networks, by wrapping each network's own call."""

    def __init__(self) -> None:
        self.seconds = 0.0
        self._open = runtimes.open_network
        runtimes.open_network = self._opened

    def _opened(self, *arguments: Any, **options: Any) -> runtimes.Network:
        network = self._open(*arguments, **options)

        def compute(feeds: dict[str, Any]) -> list[Any]:
            start = time.perf_counter()
            outputs = network.compute(feeds)
            self.seconds += time.perf_counter() - start
            return outputs

        return replace(network, compute=compute)


def peak_mib() -> float:
    """Give the peak resident memory of this process in MiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main() -> None:
    """Print medians and the share that is ours."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--runtime", default="auto")
    parser.add_argument("--detector", default="dataset", help="a YOLO .onnx instead of the masks")
    arguments = parser.parse_args()
    clock = NetworkClock()
    options = MeasureOptions(
        instances=arguments.detector, segmenter="mobile-sam", runtime=arguments.runtime
    )
    finder = make_finder(options)
    captures = [ref.load() for ref in open_source(Path(bundled_captures()))]
    whole, inside, peaks = [], [], []
    for k in range(arguments.frames + len(captures)):
        capture, clock.seconds = captures[k % len(captures)], 0.0
        start = time.perf_counter()
        fruit, _ = measure_capture(capture, finder, options)
        for number, one in enumerate(fruit, 1):
            fruit_row(capture, number, one)
        whole.append(time.perf_counter() - start)
        inside.append(clock.seconds)
        peaks.append(peak_mib())
    warm = len(captures)
    ours = [100 * (w / i - 1) for w, i in zip(whole[warm:], inside[warm:], strict=True)]
    print(f"{arguments.frames} frames of 848x480, {finder.models[0]['runtime']}")
    whole_ms, inside_ms = 1e3 * median(whole[warm:]), 1e3 * median(inside[warm:])
    print(f"whole frame {whole_ms:.0f} ms, networks {inside_ms:.0f} ms (medians)")
    print(f"added to the networks' time: {median(ours):.1f} % (median)")
    print(
        f"peak memory {peaks[warm]:.0f} MiB after the first round, {peaks[-1]:.0f} MiB at the end"
    )


if __name__ == "__main__":
    main()
