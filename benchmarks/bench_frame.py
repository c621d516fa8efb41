"""What a whole frame costs beside its networks, and whether memory stays flat.

    python benchmarks/bench_frame.py [--frames 500] [--runtime auto]
    python benchmarks/bench_frame.py --five --detector SEG.onnx --pose POSE.onnx [--fast]

Without --five it measures the bundled captures over and over: MobileSAM prompted by their masks
boxes (or by what a YOLO export finds, or the package itself: --detector models), all methods.

With --five it measures one simulated frame of 1280x720 with five fruit: detector, pose network,
MobileSAM, all methods. The networks really run, whatever they were trained on; then the five
fruit are put into the detector's answer, so that everything behind it has its full work.

Time inside the networks is taken at the runtime's own call; the rest of the frame is ours.
Processor time is of all threads together: half of it is what two idle cores would need at best.
Peak memory is the process's.
"""

from __future__ import annotations

import argparse
import resource
import time
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.capture.frames import Capture
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.capture.readers import open_source
from cucumbervision.capture.source import bundled_captures
from cucumbervision.measurement.selector import measure_fruit
from cucumbervision.perception import runtime as runtimes
from cucumbervision.perception.masks import box_of_mask
from cucumbervision.perception.resize import fit
from cucumbervision.pipeline.fields import SeenFruit, fruit_row
from cucumbervision.pipeline.finders import make_finder
from cucumbervision.pipeline.options import MeasureOptions
from cucumbervision_lab.synthesis.bodies import arc_tube, rotation
from cucumbervision_lab.synthesis.scene import Kind, Scene, render

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

CAMERA = Intrinsics(1280, 720, 910.0, 910.0, 640.0, 360.0)
LENGTHS_M = (0.16, 0.20, 0.24, 0.28, 0.22)
SCORE = 0.9


class NetworkClock:
    """Adds up the time inside the networks, by wrapping each network's own call.

    Parameters
    ----------
    planted : Capture, optional
        Whose masks a YOLO network's answer is to name.
    """

    def __init__(self, planted: Capture | None = None) -> None:
        self.start()
        self._planted = planted
        self._open = runtimes.open_network
        runtimes.open_network = self._opened

    def start(self) -> None:
        """Set all sums to nothing."""
        self.seconds: dict[str, float] = {}
        self.processor_seconds: dict[str, float] = {}
        self.planting = np.zeros(2)  # seconds, and of the processor: no frame's own

    def _opened(self, *arguments: Any, **options: Any) -> runtimes.Network:
        network = self._open(*arguments, **options)
        name = Path(network.source).stem

        def compute(feeds: dict[str, Any]) -> list[Any]:
            start = both_clocks()
            outputs = network.compute(feeds)
            spent = both_clocks() - start
            for sums, seconds in zip((self.seconds, self.processor_seconds), spent, strict=True):
                sums[name] = sums.get(name, 0.0) + seconds
            if self._planted is not None and "task" in network.metadata:
                start = both_clocks()
                size = next(iter(feeds.values())).shape[2:]
                outputs = plant(outputs, self._planted.masks, size)
                self.planting += both_clocks() - start
            return outputs

        return replace(network, compute=compute)


def both_clocks() -> NDArray[np.float64]:
    """Return the time, and the processor's of all threads, seconds."""
    return np.array([time.perf_counter(), time.process_time()])


def plant(
    outputs: Sequence[NDArray[Any]], masks: Sequence[NDArray[np.bool_]], size: tuple[int, int]
) -> list[NDArray[Any]]:
    """Return a raw YOLO answer of the same shapes that names these masks and nothing else."""
    height, width = masks[0].shape
    box = fit(height, width, size)
    rows = np.zeros_like(outputs[0])
    planted = [rows, *(np.full_like(other, -1.0) for other in outputs[1:])]
    gain = np.array([box.inner_width / width, box.inner_height / height])
    for k, mask in enumerate(masks):
        edges = (box_of_mask(mask).reshape(2, 2) + 0.5) * gain + (box.left, box.top)
        rows[0, :4, k] = [*edges.mean(axis=0), *(edges[1] - edges[0])]
        rows[0, 4, k] = SCORE - 0.01 * k
        if len(planted) > 1:
            rows[0, rows.shape[1] - 32 + k, k] = 1.0
            picture = box.apply(np.repeat(mask[..., None].astype(np.uint8), 3, axis=2))[::4, ::4, 0]
            planted[1][0, k] = np.where(picture == 1, 1.0, -1.0)
    return planted


def five_fruit() -> Capture:
    """Draw a frame of 1280x720 with five hanging fruit before a wall."""
    tubes = [
        arc_tube(long, 0.02, 0.5, neck=0.2).moved(
            rotation(-90.0, 5.0, 40.0 * k), (0.13 * (k - 2), 0.0, 0.55)
        )
        for k, long in enumerate(LENGTHS_M)
    ]
    scene = render(Scene.of(*tubes, backdrop_m=0.9), CAMERA)
    color = np.full((720, 1280, 3), (90, 110, 80), np.uint8)
    color[scene.kind == Kind.FRUIT] = (60, 140, 50)
    masks = tuple(scene.mask(k) for k in range(len(tubes)))
    depth = scene.depth_m.astype(np.float32)
    return Capture(color, depth, CAMERA, "five", masks=masks, simulated=True)


def peak_mib() -> float:
    """Return the peak resident memory of this process in MiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main() -> None:
    """Print medians and the share that is ours."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--runtime", default="auto")
    parser.add_argument("--detector", default="dataset", help="a YOLO .onnx, or models")
    parser.add_argument("--pose", type=Path, help="a YOLO pose .onnx")
    parser.add_argument("--five", action="store_true", help="one frame of 1280x720, five fruit")
    parser.add_argument("--fast", action="store_true", help="half precision where there is some")
    arguments = parser.parse_args()
    captures = (
        [five_fruit()]
        if arguments.five
        else [ref.load() for ref in open_source(Path(bundled_captures()))]
    )
    clock = NetworkClock(captures[0] if arguments.five else None)
    options = MeasureOptions(
        instances=arguments.detector,
        pose=arguments.pose,
        segmenter="mobile-sam",
        runtime=arguments.runtime,
        full_precision=not arguments.fast,
    )
    report(run(captures, options, clock, arguments.frames), captures)


def run(
    captures: Sequence[Capture], options: MeasureOptions, clock: NetworkClock, frames: int
) -> dict[str, list[float]]:
    """Measure the captures in turns; give each frame's sums after the first round."""
    finder = make_finder(options)
    sums: dict[str, list[float]] = {}
    for k in range(frames + len(captures)):
        capture = captures[k % len(captures)]
        # A picture of its own each time: SAM does not encode one twice.
        color = capture.color.copy()
        color[0, 0] = k % 256
        capture = replace(capture, color=color)
        clock.start()
        start = both_clocks()
        found = finder.find(capture)
        seen = both_clocks() - start - clock.planting
        fruit = [measure_fruit(capture, instance) for instance in found.instances]
        for number, one in enumerate(fruit, 1):
            fruit_row(SeenFruit(capture, number, one))
        whole = (both_clocks() - start - clock.planting)[0]
        if k < len(captures):
            sums["peak MiB"] = [peak_mib()]
            continue
        inside, inside_busy = sum(clock.seconds.values()), sum(clock.processor_seconds.values())
        costs: dict[str, float] = {
            "frame": whole,
            "finding": seen[0],
            "finding, processor": seen[1],
            "networks": inside,
            "networks, processor": inside_busy,
            **{f"  {name}": value for name, value in clock.seconds.items()},
            **{f"  {name}, processor": v for name, v in clock.processor_seconds.items()},
            "finding beside the networks": seen[0] - inside,
            "finding beside the networks, processor": seen[1] - inside_busy,
            "share beside, finding": 100 * (seen[0] - inside) / seen[0],
            "share beside, frame": 100 * (whole - inside) / whole,
            "found": len(found.instances),
        }
        for name, value in costs.items():
            sums.setdefault(name, []).append(value)
    sums["peak MiB"].append(peak_mib())
    print(", ".join(f"{m['name']} on {m['runtime']}" for m in finder.models))
    return sums


def report(sums: dict[str, list[float]], captures: Sequence[Capture]) -> None:
    """Print the medians and the least."""
    size = f"{captures[0].width}x{captures[0].height}"
    print(f"{len(sums['frame'])} frames of {size}, {median(sums['found']):.0f} fruit")
    for name, values in sums.items():
        if name in ("peak MiB", "found"):
            continue
        unit, scale = ("%", 1.0) if name.startswith("share") else ("ms", 1e3)
        middle, least = scale * median(values), scale * min(values)
        print(f"{name:42} {middle:7.1f} {unit} (median), {least:7.1f} {unit} (least)")
    first, last = sums["peak MiB"]
    print(f"peak memory {first:.0f} MiB after the first round, {last:.0f} MiB at the end")


if __name__ == "__main__":
    main()
