"""Every figure of docs/speed.md: ratios that are measured side by side, each part in one process.

    python benchmarks/speed.py [PART ...] [--quick] [--out FOLDER]
    python benchmarks/speed.py --show FOLDER

Parts: pipeline, processor, start, stream, kernels, tools, runtimes, naive, given, networks, ray.
Each prints a table; with --out it is kept as FOLDER/PART.json, and --show prints what a folder
holds as Markdown. What is compared takes turns or follows one another at once, since machines are
shared; only ratios mean anything on a busy one. Exit code 1 if an aim is missed.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # what is compared with the package too

import argparse
import json
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import bench_methods as kernel
from bench_frame import NetworkClock

from cucumbervision.capture.readers import open_source
from cucumbervision.capture.source import bundled_captures
from cucumbervision.measurement.methods import run_methods
from cucumbervision.measurement.result import Method
from cucumbervision.perception.registry import load_registry
from cucumbervision.pipeline.engines import Engine, Processes, in_process
from cucumbervision.pipeline.inputs import Listed, list_captures
from cucumbervision.pipeline.options import MeasureOptions
from cucumbervision.pipeline.output import OutputFolder
from cucumbervision.pipeline.run import BatchOptions, measure_inputs
from cucumbervision.pipeline.work import Task, Worker

HERE = Path(__file__).parent
MODELS = MeasureOptions(instances="models", segmenter="mobile-sam")
GIVEN = MeasureOptions(instances="dataset", segmenter="none")


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


def copies(folder: Path, count: int) -> Path:
    """Lay out the bundled captures again and again, each under a name of its own."""
    folder.mkdir()
    bundled = sorted(p for p in bundled_captures().iterdir() if p.is_dir())
    for k in range(count):
        source = bundled[k % len(bundled)]
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


def processor_ms(rounds: int) -> tuple[float, float]:
    """Return a capture's processor time in its networks, and in all else from reading to drawing.

    Each step waits for the one before, so that nobody else's work falls into the networks' time;
    what else runs on the machine matters little.
    """
    inside, beyond, clock = [], [], NetworkClock()
    with tempfile.TemporaryDirectory() as tmp:
        worker = Worker(MODELS, OutputFolder(Path(tmp)))
        captures = list_captures([bundled_captures()], MODELS.reading)
        tasks = [Task(one) for one in captures if isinstance(one, Listed)]
        for turn in range(rounds + 1):
            clock.start()
            begun = time.process_time()
            for task in tasks:
                worker(task)
            busy_s, networks_s = time.process_time() - begun, sum(clock.processor_seconds.values())
            if turn:
                inside.append(1e3 * networks_s / len(tasks))
                beyond.append(1e3 * (busy_s - networks_s) / len(tasks))
    return median(inside), median(beyond)


def pipeline(quick: bool) -> list[Figure]:
    """Compare the whole pipeline with its networks' own times, when nothing runs beside them."""
    from cucumbervision.pipeline.measurer import Measurer

    count, clock = 9 if quick else 30, NetworkClock()
    captures = [ref.load() for ref in open_source(bundled_captures())]
    alone = Measurer(MODELS)

    def networks_s() -> float:
        clock.start()
        for capture in captures:
            alone.detect(capture)
        return sum(clock.seconds.values()) / len(captures)

    networks_s()
    # Before and after, since a shared machine changes its mind.
    before_s = median(networks_s() for _ in range(count // 6))
    whole_s = pace(MODELS, in_process, count, 5)
    own_s = (before_s + median(networks_s() for _ in range(count // 6))) / 2
    return [
        Figure("a capture in the networks alone", 1e3 * own_s, "ms"),
        Figure("a capture, read to journalled", 1e3 * whole_s, "ms"),
        Figure("pipeline beyond its networks", 100 * (whole_s - own_s) / own_s, "%", "<= 8"),
    ]


def processor(quick: bool) -> list[Figure]:
    """Compare the processor time of a capture beyond its networks with that within them."""
    inside_ms, beyond_ms = processor_ms(2 if quick else 9)
    return [
        Figure("processor time of a capture in its networks", inside_ms, "ms"),
        Figure("processor time of a capture beyond them", beyond_ms, "ms"),
        Figure("processor time beyond, of that within", 100 * beyond_ms / inside_ms, "%", "<= 8"),
    ]


_START = """
import sys, time
sys.path.insert(0, sys.argv[1])
from cucumbervision.cli import app
from cucumbervision.pipeline import run
take = run._Run._take
def first(self, outcome):
    done = take(self, outcome)
    print('first', time.time(), flush=True)
    return done
run._Run._take = first
sys.argv = ['cucumbervision', *sys.argv[2:]]
app.main()
"""


def started(*words: str) -> float:
    """Return the seconds from the process's start to the first journalled capture."""
    with tempfile.TemporaryDirectory() as tmp:
        one = str(bundled_captures() / "simulated-row-b")
        command = [sys.executable, "-c", _START, str(HERE), "measure", one, "--out", tmp, *words]
        begun = time.time()
        done = subprocess.run(command, capture_output=True, text=True, check=True)
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
    for _ in range(runs):
        for name, words in ways.items():
            taken[name].append(started(*words))
    return [Figure(name, median(all_s), "s", "<= 3") for name, all_s in taken.items()]


def printed(pattern: str, script: str, *words: str) -> tuple[float, ...]:
    """Run one of the benchmarks here and take figures out of what it prints."""
    command = [sys.executable, str(HERE / script), *words]
    said = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    print(said)
    found = re.search(pattern, said, re.DOTALL)
    if found is None:
        raise SystemExit(f"{script} printed no {pattern}")
    return tuple(map(float, found.groups()))


def stream(quick: bool) -> list[Figure]:
    """Time `stream --fast` on OpenVINO at 640 pixels."""
    pattern = r"frame / networks +([\d.]+).*?([\d.]+) frames/s now.*?([\d.]+) by the"
    words = ("--frames", "10" if quick else "120", "--runtime", "openvino")
    ratio, now, reckoned = printed(pattern, "bench_stream.py", *words)
    return [
        Figure("stream --fast, OpenVINO, 640 px", now, "frames/s", ">= 20"),
        Figure("the same, reckoned from processor time", reckoned, "frames/s"),
        Figure("a frame, times its networks", ratio, "x"),
    ]


def in_turns(tasks: dict[str, Callable[[], object]], rounds: int) -> dict[str, list[float]]:
    """Return each task's milliseconds, the tasks taking turns; the first three rounds warm up."""
    taken: dict[str, list[float]] = {name: [] for name in tasks}
    for k in range(rounds + 3):
        for name, task in tasks.items():
            taken_ms = kernel.milliseconds(task)
            if k >= 3:
                taken[name].append(taken_ms)
    return taken


def kernels(quick: bool) -> list[Figure]:
    """Compare M1 to M5 with plain NumPy on a mask of 30,000 pixels."""
    floors, papers, tubes = kernel.timed(kernel.draw_region(), 10 if quick else 60)
    ratio = kernel.times_the_floor(floors, papers)
    return [
        Figure("plain NumPy floor (deproject, axis, spline)", median(floors), "ms"),
        Figure("M1 to M5 together, times the floor", ratio, "x", "<= 4"),
        Figure("M6 a fruit", median(tubes), "ms"),
    ]


def tools(quick: bool) -> list[Figure]:
    """Compare M5 and M6 with other people's tools and the plain script on the same mask."""
    from cucumbervision_lab.benchmark.baselines import available_baselines

    drawn = kernel.draw_region()
    mask = drawn.mask
    assert mask is not None
    tasks: dict[str, Callable[[], object]] = {
        str(method): lambda m=method: run_methods(kernel.fresh(drawn), [m])  # type: ignore[misc]
        for method in (Method.M5, Method.M6)
    }
    tasks["plain script"] = lambda: kernel.floor(drawn.depth_m, mask, drawn.box)
    for name, tool in available_baselines().items():
        tasks[name] = partial(tool, drawn.depth_m, mask, kernel.CAMERA)
    taken = in_turns(tasks, 5 if quick else 30)
    m5 = taken["M5"]
    figures = [Figure(f"{name} a fruit", median(ms), "ms") for name, ms in taken.items()]
    others = [name for name in taken if name not in ("M5", "M6")]
    return figures + [
        Figure(
            f"{name}, times M5", median(o / m for o, m in zip(taken[name], m5, strict=True)), "x"
        )
        for name in others
    ]


def runtimes(quick: bool) -> list[Figure]:
    """Compare ONNX Runtime with OpenVINO in float32 and bfloat16, detector and SAM's encoder."""
    from bench_runtimes import feeds_for, open_all

    figures = []
    registry = load_registry()
    for name, role, size in (("cucumber-seg", "network", 640), ("mobile-sam", "encoder", 1024)):
        networks = open_all(str(registry.resolve(name)[role]), None)
        fed = [(network, feeds_for(network, size)) for network in networks]
        tasks: dict[str, Callable[[], object]] = {
            network.runtime: partial(network.run, feeds) for network, feeds in fed
        }
        taken = in_turns(tasks, 3 if quick else 15)
        first = taken[networks[0].runtime]
        figures.append(Figure(f"{name} on {networks[0].runtime}", median(first), "ms"))
        figures += [
            Figure(
                f"{name} on {runtime}, times that",
                median(o / f for o, f in zip(ms, first, strict=True)),
                "x",
            )
            for runtime, ms in list(taken.items())[1:]
        ]
    return figures


def naive(quick: bool) -> list[Figure]:
    """Compare a loop over Ultralytics' own predictor with ours: detector's masks and one length.

    Both run the same network by ONNX Runtime; the loop adds the plain script's length.
    """
    from cucumbervision.pipeline.measurer import Measurer
    from cucumbervision_lab.training.extras import import_ultralytics

    ultralytics = import_ultralytics()

    captures = [ref.load() for ref in open_source(bundled_captures())]
    network = load_registry().resolve("cucumber-seg")["network"]
    yolo = ultralytics.YOLO(str(network), task="segment")
    options = MeasureOptions(
        instances="models",
        keypoints=False,
        segmenter="none",
        methods=(Method.M5,),
        runtime="onnxruntime",
    )
    ours = Measurer(options)
    found = [0, 0]

    def loop() -> None:
        for capture in captures:
            (result,) = yolo.predict(
                capture.color[..., ::-1], imgsz=640, conf=0.3, retina_masks=True, verbose=False
            )
            if result.masks is None:
                continue
            for mask, box in zip(
                result.masks.data.numpy() > 0.5, result.boxes.xyxy.numpy(), strict=True
            ):
                kernel.floor(capture.depth_m, mask, box)
                found[0] += 1

    def measure() -> None:
        for capture in captures:
            found[1] += len(ours.measure(capture).fruit)

    rounds = 2 if quick else 15
    taken = in_turns({"loop": loop, "ours": measure}, rounds)
    loop_ms, ours_ms = taken["loop"], taken["ours"]
    per = len(captures)
    return [
        Figure("Ultralytics loop, a picture", median(loop_ms) / per, "ms"),
        Figure("the measurer, a picture", median(ours_ms) / per, "ms"),
        Figure(
            "the loop, times the measurer",
            median(a / b for a, b in zip(loop_ms, ours_ms, strict=True)),
            "x",
        ),
        Figure("fruit a round: the loop", found[0] / (rounds + 3), ""),
        Figure("fruit a round: the measurer", found[1] / (rounds + 3), ""),
    ]


def one_and_two(options: MeasureOptions, count: int, label: str) -> list[Figure]:
    """Compare two workers with one, and with one that is kept to one core."""
    wide_s = pace(options, in_process, count, 5)
    two_s = pace(options, Processes(2), count, 5)
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(cores)})
    try:
        # A process of its own, so that it and its networks know of one core alone.
        narrow_s = pace(options, Processes(1), count, 5)
    finally:
        os.sched_setaffinity(0, cores)
    return [
        Figure(f"{label}: one worker on one core, a capture", 1e3 * narrow_s, "ms"),
        Figure(f"{label}: one worker on all cores, a capture", 1e3 * wide_s, "ms"),
        Figure(f"{label}: two workers, a capture", 1e3 * two_s, "ms"),
        Figure(f"{label}: two workers, times one on one core", narrow_s / two_s, "x", ">= 1.7"),
        Figure(f"{label}: two workers, times one on all cores", wide_s / two_s, "x"),
    ]


def given(quick: bool) -> list[Figure]:
    """Compare one worker with two where masks are given: geometry, pictures, journal."""
    return one_and_two(GIVEN, 12 if quick else 60, "given masks")


def networks(quick: bool) -> list[Figure]:
    """Compare one worker with two where all networks run."""
    return one_and_two(MODELS, 9 if quick else 24, "networks")


def ray(quick: bool) -> list[Figure]:
    """Compare two workers of one machine with Ray Data on it, masks given."""
    from cucumbervision.pipeline.ray_engine import RayEngine

    count = 12 if quick else 72
    two_s = pace(GIVEN, Processes(2), count, 6)
    ray_s = pace(GIVEN, RayEngine(workers=2), count, 6)
    return [
        Figure("given masks: two workers, a capture", 1e3 * two_s, "ms"),
        Figure("given masks: Ray with two actors, a capture", 1e3 * ray_s, "ms"),
        Figure("Ray, times two workers", ray_s / two_s, "x"),
    ]


PARTS: dict[str, Callable[[bool], list[Figure]]] = {
    part.__name__: part
    for part in (
        *(pipeline, processor, start, stream, kernels, tools),
        *(runtimes, naive, given, networks, ray),
    )
}


def machine() -> str:
    """Return what this ran on."""
    names = re.findall(r"model name\s*: (.*)", Path("/proc/cpuinfo").read_text(encoding="utf-8"))
    load = os.getloadavg()[0]
    return f"{len(os.sched_getaffinity(0))} cores, {names[0]}; load {load:.1f}"


def as_table(lines: list[dict[str, Any]]) -> str:
    """Return figures as a Markdown table."""
    rows = [Figure(**line) for line in lines]
    body = [f"| {r.what} | {r.value:.3g} {r.unit} | {r.verdict} |" for r in rows]
    return "\n".join(["| what | figure | aim |", "|---|--:|---|", *body])


def show(folder: Path) -> None:
    """Print what a folder holds, in the parts' order."""
    for name, part in PARTS.items():
        file = folder / f"{name}.json"
        if file.exists():
            kept = json.loads(file.read_text(encoding="utf-8"))
            print(f"{(part.__doc__ or '').splitlines()[0]}\n\n{as_table(kept['figures'])}\n")
            print(f"`speed.py {name}`, {kept['form']} form, {kept['when']}, {kept['machine']}\n")


def main() -> None:
    """Measure the parts, print them, and keep them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("parts", nargs="*", metavar="PART", help=", ".join(PARTS))
    parser.add_argument("--quick", action="store_true", help="a few rounds of each")
    parser.add_argument("--out", type=Path, help="folder that keeps the figures")
    parser.add_argument("--show", type=Path, help="print a folder's figures and do nothing else")
    arguments = parser.parse_args()
    if arguments.show:
        show(arguments.show)
        return
    if unknown := set(arguments.parts) - set(PARTS):
        parser.error(f"no part is called {', '.join(unknown)}; take {', '.join(PARTS)}")
    missed = False
    for name in arguments.parts or PARTS:
        loaded, when = machine(), time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime())
        figures = PARTS[name](arguments.quick)
        missed |= not all(one.kept for one in figures)
        lines = [asdict(one) for one in figures]
        print(f"{name} ({when}; {loaded})\n{as_table(lines)}\n", flush=True)
        if arguments.out:
            arguments.out.mkdir(parents=True, exist_ok=True)
            form = "quick" if arguments.quick else "full"
            kept = {"form": form, "when": when, "machine": loaded, "figures": lines}
            text = json.dumps(kept, indent=1) + "\n"
            (arguments.out / f"{name}.json").write_text(text, encoding="utf-8")
    sys.exit(missed)


if __name__ == "__main__":
    main()
