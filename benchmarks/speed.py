"""Speed as ratios that are measured side by side; only ratios mean anything on a shared machine.

    python benchmarks/speed.py [PART ...] [--quick]
    python benchmarks/speed.py dashboard    # in Chromium, with what the tests draw
    python benchmarks/speed.py card    # on a machine with an NVIDIA card: frames a second by stage
    python benchmarks/speed.py --check     # limits for CI, in processor time

Parts: pipeline, processor, start, kernels, peers, workers, dashboard. `peers` compares with
PlantCV and skan on a mask, and with Ultralytics' own prediction, and says what is not installed.
Each prints a table. The exit code is 1 if an aim or a limit is missed.

`card` runs only where it is named. It needs onnxruntime-gpu in place of onnxruntime, and takes 2
minutes on CUDA; where TensorRT is installed too, what it compiles at first takes some minutes more,
after the tables of CUDA. `timeout 600` keeps it within 12 minutes with the installation.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # what is compared with the package too

import argparse
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from pkgutil import resolve_name
from statistics import median
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # for what the tests draw

from figures import Figure, as_table, machine
from pages import dashboard

from cucumbervision.capture.frames import Capture, median_depth
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.capture.readers import open_source
from cucumbervision.capture.source import example_captures
from cucumbervision.errors import MissingExtraError
from cucumbervision.geometry.tube_kernel import kernel_name
from cucumbervision.instances.boxes import box_ious
from cucumbervision.instances.masks import box_of_mask
from cucumbervision.measurement.methods import Region, run_methods
from cucumbervision.measurement.result import MethodName
from cucumbervision.perception.registry import load_registry
from cucumbervision.perception.runtime import import_onnxruntime
from cucumbervision.perception.yolo import YoloDetector
from cucumbervision.pipeline.batch import Engine, Processes, in_process
from cucumbervision.pipeline.folder import OutputFolder
from cucumbervision.pipeline.inputs import Listed, list_captures
from cucumbervision.pipeline.measurer import Failure, Measurer
from cucumbervision.pipeline.options import MeasureOptions
from cucumbervision.pipeline.run import BatchOptions, FolderWorker, Task, measure_inputs
from cucumbervision.streaming import stream as streaming
from cucumbervision.streaming.sources import in_order
from cucumbervision.streaming.stream import FruitStream
from cucumbervision_lab.benchmark.baselines import BASELINES, available_baselines
from cucumbervision_lab.synthesis.bodies import arc_tube, rotation
from cucumbervision_lab.synthesis.depth_camera import D4xx, sense
from cucumbervision_lab.synthesis.scene import Scene, render
from cucumbervision_lab.training.checkpoint import import_ultralytics

MODELS = MeasureOptions(instances="models")
GIVEN = MeasureOptions(instances="dataset", segmenter="none")
CAMERA = Intrinsics(1280, 720, 910.0, 910.0, 640.0, 360.0)
PAPER_METHODS = (MethodName.M1, MethodName.M2, MethodName.M3, MethodName.M4, MethodName.M5)
BINS, SAMPLES = 25, 1000
TRIES = 4
LIMITS = {
    "M1 to M5, times the plain NumPy floor": 4.0,
    "M6, times the plain NumPy floor": 15.0 if kernel_name() == "numpy" else 9.0,
    "a capture with given masks, times its reading alone": 4.0,
    "cucumbervision --help, times Typer and NumPy alone": 3.5,
}


READING, WRITING = "reading", "rows and journal"
STAGES = {
    "networks": ("perception.runtime:Network.run",),
    READING: ("pipeline.run:FolderWorker.read",),
    "pictures decoded": ("capture.readers.native:_read_frame", "capture.readers.native:read_masks"),
    "a burst's motion": ("capture.motion:moved_px",),
    "a burst's median and sharpness": ("capture.frames:fuse_burst",),
    "network inputs": ("perception.resize:Letterbox.as_input", "perception.card:Levels.planes"),
    "detector's masks": ("perception.resize:Letterbox.mask_back",),
    "second look's crops": ("perception.crops:CropClassifier.rescore",),
    "stem ends' strips": ("perception.ends:EndClassifier.log_odds",),
    "depth vote": ("perception.depth_vote:with_depth_votes",),
    "pieces by depth": ("perception.pieces:join_pieces_by_depth",),
    "each fruit once": ("perception.networks:each_fruit_once",),
    "SAM's prompts and masks": ("perception.sam:Sam.segment",),
    "flower": ("instances.masks:without_flower",),
    "keypoints placed": ("perception.keypoint_axis:place_keypoints",),
    "M6": ("measurement.m6:measure_m6",),
    "M1 to M5": ("measurement.methods:run_methods",),
    "doubts of depth": ("measurement.depth_doubts:depth_doubts",),
    "pose": ("measurement.pose:fruit_pose",),
    "intervals": ("measurement.selector:with_length",),
    "look at ends": ("measurement.end_looks:with_end_looks",),
    "traits": ("measurement.trait_values:with_traits",),
    "overlay": ("pipeline.run:FolderWorker.draw",),
    WRITING: ("pipeline.run:FolderWorker.make",),
}
"""Functions of the package by stage; a stage's time is without the stages that it calls."""

OUTSIDE = (
    *(READING, "pictures decoded", "a burst's motion", "a burst's median and sharpness"),
    *("overlay", WRITING),
)
"""Stages that read or write files, and fuse what was read."""


class StageClock:
    """Adds up the processor time of `STAGES`, by wrapping their functions; one to a process."""

    def __init__(self, now_s: Callable[[], float] = time.process_time) -> None:
        self._now_s = now_s
        self._inside_s = [0.0]  # in the stages called by each that runs
        self.start()
        for stage, paths in STAGES.items():
            for path in paths:
                self._wrap(stage, path)

    def start(self) -> None:
        """Set all sums to zero."""
        self.taken_s = dict.fromkeys(STAGES, 0.0)

    def _wrap(self, stage: str, path: str) -> None:
        module, _, place = path.partition(":")
        owner_name, _, name = place.rpartition(".")
        owner = resolve_name(f"cucumbervision.{module}" + (f":{owner_name}" if owner_name else ""))
        function = getattr(owner, name)

        def timed(*given: Any, **options: Any) -> Any:
            begun = self._now_s()
            self._inside_s.append(0.0)
            try:
                return function(*given, **options)
            finally:
                taken_s = self._now_s() - begun
                self.taken_s[stage] += taken_s - self._inside_s.pop()
                self._inside_s[-1] += taken_s

        setattr(owner, name, timed)
        for user in [m for key, m in sys.modules.items() if key.startswith("cucumbervision")]:
            for known in [key for key, value in vars(user).items() if value is function]:
                setattr(user, known, timed)


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


def stage_ms(
    clock: StageClock, tasks: Sequence[Callable[[], object]], rounds: int
) -> dict[str, float]:
    """Return the median processor time of a task by stage, and of the rest; tasks take turns.

    Each step waits for the one before, so that nobody else's work falls into a stage's time;
    what else runs on the machine matters little.
    """
    turns = []
    for _ in range(rounds + 1):
        clock.start()
        begun = time.process_time()
        for task in tasks:
            task()
        taken_s = {**clock.taken_s, "rest": time.process_time() - begun}
        taken_s["rest"] -= sum(clock.taken_s.values())
        turns.append({stage: 1e3 * seconds / len(tasks) for stage, seconds in taken_s.items()})
    return {stage: median(turn[stage] for turn in turns[1:]) for stage in turns[0]}


def by_stage(label: str, stages: dict[str, float]) -> list[Figure]:
    """Return the lines of `stage_ms`, and the share beyond the networks without files."""
    inside_ms = stages["networks"]
    beyond_ms = sum(stages.values()) - inside_ms
    lean_ms = beyond_ms - sum(stages[stage] for stage in OUTSIDE)
    return [
        Figure(f"{label}: processor time in the networks", inside_ms, "ms"),
        Figure(f"{label}: processor time beyond them", beyond_ms, "ms"),
        Figure(
            f"{label}: the same but for files, of the networks'",
            100 * lean_ms / inside_ms,
            "%",
            "<= 15",
        ),
        *(
            Figure(f"{label}: {stage}", value, "ms")
            for stage, value in sorted(stages.items(), key=lambda pair: -pair[1])
            if stage != "networks" and value >= 0.05
        ),
    ]


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
        Figure("a capture, read to journalled", 1e3 * whole_s, "ms"),
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


def processor(quick: bool) -> list[Figure]:
    """Compare the processor time of a capture beyond its networks with that within them."""
    rounds = 2 if quick else 9
    captures = list_captures([example_captures()], MODELS.reading)
    listed = [one for one in captures if isinstance(one, Listed)]
    clock, stream = StageClock(), FruitStream.fast(MODELS)
    frames = [one.ref.load() for one in listed]
    with tempfile.TemporaryDirectory() as tmp:
        worker = FolderWorker(Measurer(MODELS), OutputFolder(Path(tmp)))
        tasks = [partial(worker, Task(**vars(one))) for one in listed]
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


_START = """
import sys, time
from cucumbervision.cli import app
from cucumbervision.pipeline import run
take = run._Run._take
def first(self, *given):
    done = take(self, *given)
    print('first', time.time(), flush=True)
    return done
run._Run._take = first
sys.argv = ['cucumbervision', *sys.argv[1:]]
app.main()
"""


def started(compiled: Path, *words: str) -> float:
    """Return the seconds from the process's start to the first journalled capture.

    Python keeps what it compiled of the sources in a folder, as it does where they are installed.
    """
    environment = {**os.environ, "PYTHONPYCACHEPREFIX": str(compiled)}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    with tempfile.TemporaryDirectory() as tmp:
        capture, out = str(example_captures() / "simulated-row-b"), str(Path(tmp) / "out")
        command = [sys.executable, "-c", _START, "measure", capture, "--out", out, *words]
        begun = time.time()
        done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    found = re.search(r"first ([\d.]+)", done.stdout)
    if found is None:
        raise SystemExit(done.stdout + done.stderr)
    return float(found[1]) - begun


def start(quick: bool) -> list[Figure]:
    """Time the way to the first result."""
    runs = 1 if quick else 5
    ways = {
        "start to first result, all networks": ("--instances", "models"),
        "start to first result, given masks": ("--instances", "dataset"),
    }
    taken: dict[str, list[float]] = {name: [] for name in ways}
    with tempfile.TemporaryDirectory() as compiled:
        for _ in range(1 + runs):
            for name, words in ways.items():
                taken[name].append(started(Path(compiled), *words))
    return [Figure(name, median(all_s[1:]), "s", "<= 3") for name, all_s in taken.items()]


def draw_region() -> Region:
    """Draw a fruit whose mask has about 30,000 pixels, with its keypoints."""
    tube = arc_tube(0.25, 0.0205, 0.5, neck=0.2).moved(rotation(8, 10), (0.0, 0.0, 0.52))
    scene = Scene.of(tube, backdrop_m=0.9)
    depth = median_depth(sense(scene, D4xx.like(CAMERA), np.random.default_rng(1)))
    axis = tube.axis_m[np.linspace(12, len(tube.axis_m) - 13, 5).astype(int)]
    pixels = axis[:, :2] / axis[:, 2:] * CAMERA.fx_px + (CAMERA.cx_px, CAMERA.cy_px)
    keypoints = np.column_stack([pixels, np.ones(5)])
    mask = render(scene, CAMERA).mask(0)
    return Region(depth, CAMERA, box_of_mask(mask), mask, keypoints)


def floor(depth_m: NDArray[np.float32], mask: NDArray[np.bool_], box: NDArray[Any]) -> float:
    """Measure along 25 centroids in plain NumPy, without a gate, anchors or checks."""
    left, top, right, bottom = (int(x + 0.5) for x in box)
    part = depth_m[top:bottom, left:right]
    v, u = np.nonzero(mask[top:bottom, left:right] & (part > 0))
    z = part[v, u].astype(np.float64)
    x = (u + (left - CAMERA.cx_px)) / CAMERA.fx_px * z
    y = (v + (top - CAMERA.cy_px)) / CAMERA.fy_px * z
    points = np.stack([x, y, z], axis=1)
    centred = points - points.mean(axis=0)
    along = centred @ np.linalg.eigh(centred.T @ centred)[1][:, -1]
    low, high = along.min(), along.max()
    which = np.minimum(((along - low) * (BINS / (high - low))).astype(np.intp), BINS - 1)
    count = np.bincount(which, minlength=BINS)
    held = np.flatnonzero(count)  # a stray reading far off stretches the axis, and leaves gaps
    sums = np.stack([np.bincount(which, points[:, k], BINS) for k in range(3)], axis=1)
    spine = sums[held] / count[held, None]
    parameter = held / (BINS - 1)
    speed = CubicSpline(parameter, spine, bc_type="natural")(np.linspace(0, 1, SAMPLES), 1)
    return float(np.trapezoid(np.linalg.norm(speed, axis=1), dx=1 / (SAMPLES - 1)))


def milliseconds(task: Callable[[], object]) -> float:
    """Return one call's processor time, which what else runs touches less than the clock's."""
    start = time.process_time()
    task()
    return 1e3 * (time.process_time() - start)


def fresh(drawn: Region) -> Region:
    """Return the region without its clouds, which each timing must build anew."""
    return Region(drawn.depth_m, CAMERA, drawn.box, drawn.mask, drawn.keypoints)


def timed(drawn: Region, rounds: int) -> tuple[list[float], list[float], list[float]]:
    """Return the milliseconds of the floor, of M1 to M5 and of M6, taken in turns."""
    mask = drawn.mask
    assert mask is not None
    floors, papers, tubes = [], [], []
    for _ in range(rounds + 5):
        floors.append(milliseconds(lambda: floor(drawn.depth_m, mask, drawn.box)))
        papers.append(milliseconds(lambda: run_methods(fresh(drawn), PAPER_METHODS)))
        tubes.append(milliseconds(lambda: run_methods(fresh(drawn), [MethodName.M6])))
    return floors[5:], papers[5:], tubes[5:]


def times_the_floor(floors: list[float], papers: list[float]) -> float:
    """Return the median ratio of the pairs."""
    return median(p / f for p, f in zip(papers, floors, strict=True))


def kernels(quick: bool) -> list[Figure]:
    """Compare M1 to M5 with plain NumPy on a mask of 30,000 pixels."""
    floors, papers, tubes = timed(draw_region(), 10 if quick else 60)
    ratio = times_the_floor(floors, papers)
    return [
        Figure("plain NumPy floor (deproject, axis, spline)", median(floors), "ms"),
        Figure("M1 to M5 together, times the floor", ratio, "x", "<= 4"),
        Figure(f"M6 a fruit, kernel {kernel_name()}", median(tubes), "ms"),
        Figure("the same, times the floor", times_the_floor(floors, tubes), "x"),
    ]


def in_turns(tasks: dict[str, Callable[[], object]], rounds: int) -> dict[str, float]:
    """Return the median milliseconds of each task; they take turns, after two for warming up."""
    turns = [{name: milliseconds(task) for name, task in tasks.items()} for _ in range(rounds + 2)]
    return {name: median(turn[name] for turn in turns[2:]) for name in tasks}


def peers(quick: bool) -> list[Figure]:
    """Compare processor times with other programs: lengths on one mask, detection in pictures."""
    drawn, rounds = draw_region(), 5 if quick else 30
    mask = drawn.mask
    assert mask is not None
    tasks: dict[str, Callable[[], object]] = {
        "M1 to M5": lambda: run_methods(fresh(drawn), PAPER_METHODS),
        "M6": lambda: run_methods(fresh(drawn), [MethodName.M6]),
    }
    installed_baselines = available_baselines()
    for name in BASELINES:
        if name not in installed_baselines:
            print(f"{name} is not installed")
            continue
        named = f"{name} {version(name)}"
        tasks[named] = partial(installed_baselines[name], drawn.depth_m, mask, CAMERA)
    taken_ms = in_turns(tasks, rounds)
    floor_ms = in_turns({"": lambda: floor(drawn.depth_m, mask, drawn.box)}, rounds)[""]
    figures = [
        Figure(f"a length by {name}, times the plain NumPy floor", value / floor_ms, "x")
        for name, value in taken_ms.items()
    ]
    return figures + detection_by_peers(rounds)


def detection_by_peers(rounds: int) -> list[Figure]:
    """Compare our detector with Ultralytics' prediction by the same network and runtime."""
    try:
        ultralytics = import_ultralytics()
    except MissingExtraError:
        print("Ultralytics is not installed")
        return []
    import torchvision
    from ultralytics.utils.nms import TorchNMS

    if not torchvision.extension._has_ops():  # a build for another torch
        torchvision.ops.nms = TorchNMS.nms
    registry = load_registry()
    model = registry.default("segment")
    assert model is not None
    path = registry.resolve(model.name)["network"]
    colors = [capture.color for capture in bundled()]
    ours = YoloDetector(path, "onnxruntime", input_sizes=(640,), full_precision=True)
    theirs = ultralytics.YOLO(path, task="segment")
    told = {"imgsz": 640, "conf": 0.25, "retina_masks": True, "verbose": False, "device": "cpu"}
    taken_ms = in_turns(
        {
            "ours": lambda: [ours.detect(color) for color in colors],
            "theirs": lambda: [theirs.predict(color[..., ::-1], **told) for color in colors],
        },
        rounds,
    )
    ratio = taken_ms["ours"] / taken_ms["theirs"]
    name = f"Ultralytics {ultralytics.__version__}, with the same network and ONNX Runtime"
    return [Figure(f"detection at 640, times the prediction of {name}", ratio, "x")]


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


ON_CARD = {
    "card, float32": MeasureOptions(instances="models", runtime="cuda", full_precision=True),
    "card, TF32": MeasureOptions(instances="models", runtime="cuda", full_precision=False),
    "card, TensorRT in half precision": MeasureOptions(
        instances="models", runtime="tensorrt", full_precision=False
    ),
}
NEEDED = {"cuda": "CUDAExecutionProvider", "tensorrt": "TensorrtExecutionProvider"}


def card_figures(options: MeasureOptions, quick: bool) -> list[Figure]:
    """Time a stream's frames by stage on a card, and compare lengths with the processor's."""
    rounds = 3 if quick else 40
    captures = [five_fruit()]
    measurer, clock = Measurer(options), StageClock(time.perf_counter)
    figures = lengths_beside_the_processors(measurer, [*bundled(), *captures])
    streams = {"--fast": FruitStream.fast(options), "all networks": FruitStream(measurer)}
    aims = {"--fast": ">= 60", "all networks": ">= 30"}
    for name, stream in streams.items():
        stages_ms = by_turn_ms(clock, stream, captures, rounds)
        fruit = sum(len(stream.take(capture).fruit) for capture in captures) / len(captures)
        label = f"stream, {name}"
        frame_ms = sum(stages_ms.values())
        rate, lag_s = overlapped(stream, captures, rounds)
        figures += [
            Figure(f"{label}, {fruit:.1f} fruit a frame", 1e3 / frame_ms, "frames/s", aims[name]),
            Figure(f"{label}, searched ahead", rate, "frames/s"),
            Figure(f"{label}, from a frame to its line", 1e3 * lag_s, "ms"),
            *(
                Figure(f"{label}: {stage}, alone {1e3 / ms:.0f} frames/s", ms, "ms")
                for stage, ms in sorted(stages_ms.items(), key=lambda pair: -pair[1])
                if ms >= 0.05
            ),
        ]
    return figures


def by_turn_ms(
    clock: StageClock, stream: FruitStream, captures: Sequence[Capture], rounds: int
) -> dict[str, float]:
    """Return the median time of a frame by stage, by the clock on the wall."""
    turns = []
    for turn in range(rounds + 2):
        clock.start()
        begun = time.perf_counter()
        for capture in captures:
            stream.take(capture)
        taken_s = {**clock.taken_s, "rest": time.perf_counter() - begun}
        taken_s["rest"] -= sum(clock.taken_s.values())
        if turn > 1:
            turns.append({stage: 1e3 * s / len(captures) for stage, s in taken_s.items()})
    return {stage: median(turn[stage] for turn in turns) for stage in turns[0]}


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


def lengths_beside_the_processors(measurer: Measurer, captures: Sequence[Capture]) -> list[Figure]:
    """Compare the lengths of the same fruit with those that float32 on the processor gives."""
    reference = Measurer(replace(MODELS, runtime="onnxruntime", full_precision=True))
    errors_cm, unpaired = [], 0
    for capture in captures:
        on_card = list(measurer.measure(capture).fruit)
        for fruit in reference.measure(capture).fruit:
            boxes = np.array([candidate.instance.box for candidate in on_card]).reshape(-1, 4)
            ious = box_ious(fruit.instance.box[None], boxes)[0]
            if not ious.size or ious.max() <= 0.5:
                unpaired += 1
                continue
            lengths = fruit.length, on_card.pop(int(ious.argmax())).length
            values_m = [length.value_m for length in lengths if length is not None]
            unpaired += len(values_m) == 1
            errors_cm += [100 * abs(values_m[0] - values_m[1])] if len(values_m) == 2 else []
        unpaired += len(on_card)
    return [
        Figure("fruit measured on both", len(errors_cm), "fruit"),
        Figure("fruit measured on one alone", unpaired, "fruit", "<= 0"),
        Figure("lengths off the processor's, most", max(errors_cm, default=0.0), "cm", "<= 0.02"),
    ]


def card_parts() -> dict[str, Callable[[bool], list[Figure]]]:
    """Return what can be timed on the card of this machine; ends where there is none."""
    providers = import_onnxruntime().get_available_providers()
    if NEEDED["cuda"] not in providers:
        raise SystemExit(
            f"card: ONNX Runtime has no {NEEDED['cuda']} here; on a machine with an NVIDIA card "
            "install onnxruntime-gpu in place of onnxruntime"
        )
    return {
        name: partial(card_figures, options)
        for name, options in ON_CARD.items()
        if NEEDED[options.runtime] in providers
    }


PARTS: dict[str, Callable[[bool], list[Figure]]] = {
    part.__name__: part for part in (pipeline, processor, start, kernels, peers, workers, dashboard)
}


def children_s() -> float:
    """Return the processor time of all processes that were started and have ended."""
    times = os.times()
    return times.children_user + times.children_system


def help_times_its_libraries() -> float:
    """Compare the console script's help with a start that loads what it cannot do without."""

    def seconds(code: str) -> float:
        start = children_s()
        subprocess.run([sys.executable, "-c", code, "--help"], check=True, capture_output=True)
        return children_s() - start

    program, libraries = "from cucumbervision.cli.app import main; main()", "import typer, numpy"
    turns = [(seconds(program), seconds(libraries)) for _ in range(TRIES)]
    return min(own for own, _ in turns) / min(alone for _, alone in turns)


def times_its_reading() -> float:
    """Compare a capture's way through the pipeline with reading it: what is added to every one."""
    captures = list(open_source(example_captures()))

    def read() -> None:
        for ref in captures:
            ref.load()

    read()
    reading_s = 1e-3 * milliseconds(read) / len(captures)
    return pace(GIVEN, in_process, 9, 3, time.process_time) / reading_s


def check() -> int:
    """Print each quick ratio beside its limit: what CI runs. The best of a few tries counts."""
    drawn = draw_region()
    turns = [timed(drawn, 20) for _ in range(TRIES)]
    ratios = (
        min(times_the_floor(floors, papers) for floors, papers, _ in turns),
        min(times_the_floor(floors, m6) for floors, _, m6 in turns),
        min(times_its_reading() for _ in range(TRIES)),
        help_times_its_libraries(),
    )
    for (name, limit), ratio in zip(LIMITS.items(), ratios, strict=True):
        print(f"{name}: {ratio:.2f} (limit {limit:.2f}) {'ok' if ratio <= limit else 'TOO SLOW'}")
    return int(any(ratio > limit for ratio, limit in zip(ratios, LIMITS.values(), strict=True)))


def main() -> None:
    """Measure the parts, print them, and keep them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("parts", nargs="*", metavar="PART", help=", ".join([*PARTS, "card"]))
    parser.add_argument("--quick", action="store_true", help="a few rounds of each")
    parser.add_argument("--check", action="store_true", help="compare quick ratios with limits")
    arguments = parser.parse_args()
    if arguments.check:
        sys.exit(check())
    if unknown := set(arguments.parts) - {*PARTS, "card"}:
        parser.error(f"no part is called {', '.join(unknown)}; take {', '.join([*PARTS, 'card'])}")
    parts: dict[str, Callable[[bool], list[Figure]]] = {}
    for name in arguments.parts or PARTS:
        parts |= card_parts() if name == "card" else {name: PARTS[name]}
    missed = False
    for name, part in parts.items():
        loaded, when = machine(), time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime())
        figures = part(arguments.quick)
        missed |= not all(one.kept for one in figures)
        print(f"{name} ({when}; {loaded})\n{as_table(figures)}\n", flush=True)
    sys.exit(missed)


if __name__ == "__main__":
    main()
