"""What SAM costs a frame: each network, our own share, memory over many frames.

    python benchmarks/bench_sam.py [--model mobile-sam] [--frames 60] [--fruit 4]

Every runtime that is installed is timed in a process of its own on a drawn 1280x720 picture;
medians. What a whole frame costs beside its networks, `bench_frame.py` tells.
"""

from __future__ import annotations

import argparse
import importlib.util
import multiprocessing
import resource
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from statistics import median

import cv2
import numpy as np
from numpy.typing import NDArray

from cucumbervision.perception.instances import Instance
from cucumbervision.perception.registry import load_registry
from cucumbervision.perception.resize import mask_from_logits, prepare_picture
from cucumbervision.perception.runtime import open_network
from cucumbervision.perception.sam import Segmenter

SIZE = (720, 1280)


def drawn_scene(fruit: int) -> tuple[NDArray[np.uint8], list[Instance]]:
    """Draw green tubes side by side on a textured ground."""
    rng = np.random.default_rng(0)
    grain = cv2.GaussianBlur(rng.normal(0, 60, (*SIZE, 3)), (0, 0), 3)
    picture = np.clip(np.array([120, 85, 55]) + grain, 0, 255).astype(np.uint8)
    instances = []
    for k in range(fruit):
        u = int(SIZE[1] * (k + 0.5) / fruit)
        cv2.line(picture, (u - 15, 180), (u + 15, 540), (50, 130, 45), 50)
        instances.append(Instance(np.array([u - 41.0, 154.0, u + 41.0, 566.0])))
    return picture, instances


def resident_mib() -> float:
    """Return the resident memory of this process now, in MiB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 2**20


def whole_frames(model: str, runtime: str, frames: int, fruit: int) -> dict[str, float | str]:
    """Segment the scene over and over; give time and memory."""
    picture, instances = drawn_scene(fruit)
    segmenter = Segmenter(model, runtime)
    segmenter.segment(picture, instances)
    seconds, memory = [], []
    for _ in range(frames):
        start = time.perf_counter()
        segmenter.segment(picture, instances)
        seconds.append(time.perf_counter() - start)
        memory.append(resident_mib())
    return {
        "runtime": segmenter.runtime,
        "frame_ms": 1e3 * median(seconds),
        "early_mib": memory[len(memory) // 10],
        "last_mib": memory[-1],
        "peak_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }


def parts(model: str, runtime: str, fruit: int) -> dict[str, float]:
    """Time the parts of a frame apart, each after a first call that does not count."""
    picture, _ = drawn_scene(fruit)
    files = load_registry().resolve(model)
    encoder = open_network(files["encoder"], runtime)
    decoder = open_network(
        files["decoder"], "onnxruntime" if runtime == "auto" else runtime, full_precision=True
    )
    image = prepare_picture(picture)
    embedding = encoder.run({"image": image})["embedding"]
    points = np.tile(np.array([[640, 280], [600, 120], [680, 450]], np.float32), (4, 1, 1))
    labels = np.tile(np.array([1, 2, 3]), (4, 1))
    feeds = {"embedding": embedding, "points": points, "labels": labels}
    one = {"embedding": embedding, "points": points[:1], "labels": labels[:1]}
    logits = decoder.run(feeds)["logits"][0, 0]
    calls: dict[str, Callable[[], object]] = {
        "prepare_ms": lambda: prepare_picture(picture),
        "encoder_ms": lambda: encoder.run({"image": image}),
        "decoder_1_ms": lambda: decoder.run(one),
        "decoder_4_ms": lambda: decoder.run(feeds),
        "mask_ms": lambda: mask_from_logits(logits, *SIZE),
    }
    result = {}
    for name, call in calls.items():
        seconds = []
        for _ in range(16):
            start = time.perf_counter()
            call()
            seconds.append(time.perf_counter() - start)
        result[name] = 1e3 * median(seconds[1:])
    return result


def main() -> None:
    """Print a block for each runtime."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--model", default="mobile-sam")
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--fruit", type=int, default=4)
    arguments = parser.parse_args()
    runtimes = ["onnxruntime"]
    if importlib.util.find_spec("openvino"):
        runtimes += ["openvino", "auto"]
    fresh = multiprocessing.get_context("spawn")
    for runtime in runtimes:
        words = (arguments.model, runtime)
        with ProcessPoolExecutor(1, mp_context=fresh) as pool:
            whole = pool.submit(whole_frames, *words, arguments.frames, arguments.fruit).result()
        with ProcessPoolExecutor(1, mp_context=fresh) as pool:
            apart = pool.submit(parts, *words, arguments.fruit).result()
        print(f"\n{runtime}: encoder by {whole['runtime']}, {arguments.fruit} fruit")
        for name, value in apart.items():
            print(f"  {name:14} {value:8.1f}")
        print(f"  {'frame_ms':14} {whole['frame_ms']:8.1f}")
        memory = f"{whole['early_mib']:.0f} MiB after a tenth, {whole['last_mib']:.0f} at the last"
        print(
            f"  memory over {arguments.frames} frames: {memory}, peak {whole['peak_mib']:.0f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
