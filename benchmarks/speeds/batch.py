"""Captures, streams, workers and the start of the program; on an NVIDIA GPU too."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from statistics import median

import numpy as np

from cucumbervision.capture.frames import Capture
from cucumbervision.capture.source import example_captures
from cucumbervision.fruit.masks import box_ious
from cucumbervision.networks.runtime import import_onnxruntime
from cucumbervision.run.batch import Processes, in_process
from cucumbervision.run.measurer import Measurer
from cucumbervision.run.options import MeasureOptions
from cucumbervision.stream.fruit_stream import FruitStream
from speeds.timing import GIVEN, MODELS, Figure, bundled, five_fruit, overlapped, pace

ON_GPU = {
    "GPU, float32": ("cuda", True),
    "GPU, TF32": ("cuda", False),
    "GPU, TensorRT in half precision": ("tensorrt", False),
}
NEEDED = {"cuda": "CUDAExecutionProvider", "tensorrt": "TensorrtExecutionProvider"}


def pipeline(quick: bool) -> list[Figure]:
    """Time a capture from disk to disk, and a frame in memory with five fruit."""
    count = 9 if quick else 30
    whole_s = pace(MODELS, in_process, count, 5)
    one_size_s = pace(replace(MODELS, input_sizes=(640,)), in_process, count, 5)
    measurer, frame, taken_s = Measurer(MODELS), five_fruit(), []
    for _ in range(count):
        begun = time.perf_counter()
        fruit = measurer.measure(frame).fruit
        taken_s.append(time.perf_counter() - begun)
    name = f"a frame in memory with {len(fruit)} fruit, all networks"
    return [
        Figure(name, 1e3 * median(taken_s), "ms", "<= 300"),
        Figure("a capture, read to saved", 1e3 * whole_s, "ms"),
        Figure("the same, times one at the input size 640", whole_s / one_size_s, "x"),
    ]


def measured_alone_s(compiled: Path, instances: str) -> float:
    """Return the seconds that the program takes for one capture.

    Python keeps what it compiled of the sources in a folder, as it does where they are installed.
    """
    environment = {**os.environ, "PYTHONPYCACHEPREFIX": str(compiled)}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    code = "from cucumbervision.cli.app import main; main()"
    with tempfile.TemporaryDirectory() as folder:
        words = ["measure", str(example_captures() / "simulated-row-b"), "--out", f"{folder}/out"]
        command = [sys.executable, "-c", code, *words, "--instances", instances]
        begun = time.perf_counter()
        subprocess.run(command, capture_output=True, check=True, env=environment)
    return time.perf_counter() - begun


def start(quick: bool) -> list[Figure]:
    """Time the program from its start to its end with one capture."""
    ways, taken_s = {"models": "all networks", "dataset": "given masks"}, []
    with tempfile.TemporaryDirectory() as compiled:
        for _ in range(2 if quick else 6):
            taken_s.append([measured_alone_s(Path(compiled), instances) for instances in ways])
    return [
        Figure(f"start to end, one capture, {name}", median(runs_s[1:]), "s", "<= 3")
        for name, runs_s in zip(ways.values(), zip(*taken_s, strict=True), strict=True)
    ]


def workers(quick: bool) -> list[Figure]:
    """Compare two workers with one on one core, with all networks and with given masks."""
    figures = []
    for label, options, count in (("networks", MODELS, 24), ("given masks", GIVEN, 60)):
        count = max(9, count // 5) if quick else count
        two_s = pace(options, Processes(2), count, 5)
        cores = os.sched_getaffinity(0)
        os.sched_setaffinity(0, {min(cores)})
        try:
            one_s = pace(options, Processes(1), count, 5)
        finally:
            os.sched_setaffinity(0, cores)
        name = f"{label}: two workers, times one on one core"
        figures.append(Figure(name, one_s / two_s, "x", ">= 1.7"))
    return figures


def gpu_figures(options: MeasureOptions, quick: bool) -> list[Figure]:
    """Time streams on a GPU, and compare lengths with the processor's."""
    captures, measurer = [five_fruit()], Measurer(options)
    figures = lengths_beside_the_processors(measurer, [*bundled(), *captures])
    streams = (
        ("--fast", FruitStream.fast(options), ">= 60"),
        ("all networks", FruitStream(measurer), ">= 30"),
    )
    for name, stream, aim in streams:
        rate, latency_s = overlapped(stream, captures, 3 if quick else 40)
        figures += [
            Figure(f"stream, {name}, five fruit a frame", rate, "frames/s", aim),
            Figure(f"stream, {name}: from a frame to its line", 1e3 * latency_s, "ms"),
        ]
    return figures


def lengths_beside_the_processors(measurer: Measurer, captures: Sequence[Capture]) -> list[Figure]:
    """Compare the lengths of the same fruit with those that float32 on the processor gives."""
    reference = Measurer(replace(MODELS, runtime="onnxruntime", full_precision=True))
    errors_cm, unpaired = [], 0
    for capture in captures:
        on_gpu = list(measurer.measure(capture).fruit)
        for fruit in reference.measure(capture).fruit:
            boxes = np.array([candidate.instance.box for candidate in on_gpu]).reshape(-1, 4)
            ious = box_ious(fruit.instance.box[None], boxes)[0]
            if not ious.size or ious.max() <= 0.5:
                unpaired += 1
                continue
            lengths = fruit.length, on_gpu.pop(int(ious.argmax())).length
            values_m = [length.value_m for length in lengths if length is not None]
            unpaired += len(values_m) == 1
            errors_cm += [100 * abs(values_m[0] - values_m[1])] if len(values_m) == 2 else []
        unpaired += len(on_gpu)
    return [
        Figure("fruit measured on both", len(errors_cm), "fruit"),
        Figure("fruit measured on one alone", unpaired, "fruit", "<= 0"),
        Figure("lengths off the processor's, most", max(errors_cm, default=0.0), "cm", "<= 0.02"),
    ]


def gpu_parts() -> dict[str, Callable[[bool], list[Figure]]]:
    """Return what can be timed on the GPU of this machine; ends where there is none."""
    providers = import_onnxruntime().get_available_providers()
    if NEEDED["cuda"] not in providers:
        raise SystemExit(
            f"gpu: ONNX Runtime has no {NEEDED['cuda']} here; on a machine with an NVIDIA GPU "
            "install onnxruntime-gpu in place of onnxruntime"
        )
    return {
        name: partial(gpu_figures, replace(MODELS, runtime=runtime, full_precision=full))
        for name, (runtime, full) in ON_GPU.items()
        if NEEDED[runtime] in providers
    }
