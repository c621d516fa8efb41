"""Time one network under every runtime that is here, side by side in one run.

    python benchmarks/bench_runtimes.py network.onnx [--size 640] [--runs 30] [--threads 2]

The runtimes take turns, so that a busy machine slows all of them alike; the ratio is to the first.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from cucumbervision.errors import CucumberVisionError
from cucumbervision.perception.runtime import Network, open_network

CHOICES = (("onnxruntime", True), ("openvino", True), ("openvino", False), ("cuda", True))
PAUSE_S = 0.02  # lets one runtime's waiting threads go to sleep before the next is timed


def open_all(path: str, threads: int | None) -> list[Network]:
    """Open the network under every runtime that can load it."""
    networks: list[Network] = []
    for runtime, full in CHOICES:
        try:
            network = open_network(path, runtime, full_precision=full, threads=threads)
        except CucumberVisionError as error:
            print(f"left out: {error}")
            continue
        if network.runtime not in [n.runtime for n in networks]:
            networks.append(network)
    return networks


def feeds_for(network: Network, size: int) -> dict[str, np.ndarray]:
    """Return random pictures; free sides get `size`, a free batch 1."""
    rng = np.random.default_rng(0)
    feeds = {}
    for info in network.inputs:
        shape = [n or (1 if axis == 0 else size) for axis, n in enumerate(info.shape)]
        feeds[info.name] = rng.random(shape).astype(info.dtype)
    return feeds


def main() -> None:
    """Read the arguments, take turns, print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("network")
    parser.add_argument("--size", type=int, default=640)
    parser.add_argument("--runs", type=int, default=30)
    parser.add_argument("--threads", type=int, default=None)
    options = parser.parse_args()
    networks = open_all(options.network, options.threads)
    if not networks:
        raise SystemExit(1)
    times_s: list[list[float]] = [[] for _ in networks]
    for turn in range(options.runs + 3):
        for network, kept in zip(networks, times_s, strict=True):
            feeds = feeds_for(network, options.size)
            time.sleep(PAUSE_S)
            start = time.perf_counter()
            network.run(feeds)
            if turn >= 3:
                kept.append(time.perf_counter() - start)
    floor = float(np.median(times_s[0]))
    print(f"{'runtime':24} {'median ms':>9} {'ratio':>6} {'fastest':>8}")
    for network, kept in zip(networks, times_s, strict=True):
        median = float(np.median(kept))
        fastest = min(kept) * 1e3
        print(f"{network.runtime:24} {median * 1e3:9.1f} {median / floor:6.2f} {fastest:8.1f}")


if __name__ == "__main__":
    main()
