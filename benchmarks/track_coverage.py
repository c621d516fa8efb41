"""Whether the 90 % intervals of a track hold, on drawn fruit that a camera passes.

    python benchmarks/track_coverage.py [--fruit 150] [--places 5] [--frames 3]

Each fruit, partly behind leaves, is taken in some frames from each of some places along the row, by
a simulated D4xx with a depth scale of its own and outlines that are disturbed anew at each place.
The frames go through `FruitStream`, which must keep them in one track; the thread's true length is
held against the track's interval after the first frame, after the first place, and at the end.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
from track_noise import CAMERA

from cucumbervision.capture.frames import Capture
from cucumbervision.measurement.intervals import SCALE_SD
from cucumbervision.measurement.result import Length, LengthDefinition, Method
from cucumbervision.pipeline.measurer import Measurer
from cucumbervision.pipeline.options import MeasureOptions
from cucumbervision.streaming.stream import FruitStream
from cucumbervision_lab.benchmark.measure_case import (
    OUTLINE_RMS_PX,
    disturb_mask,
    draw_disturbance,
)
from cucumbervision_lab.synthesis.bodies import random_fruit
from cucumbervision_lab.synthesis.depth_camera import D4xx, sense
from cucumbervision_lab.synthesis.placing import occlude, place_hanging, trellis
from cucumbervision_lab.synthesis.scene import render, truth_of

STEP_M = 0.07  # between two places: beyond a tenth of every distance, so each is a place of its own
FPS = 6


def pass_by(seed: int, places: int, frames: int) -> tuple[float, list[Length | None], int]:
    """Return a fruit's true thread length, the track's length after each frame, and its tracks."""
    rng = np.random.default_rng(seed)
    camera = replace(D4xx.like(CAMERA), scale_error=float(rng.normal(0, SCALE_SD)))
    far_m = float(rng.uniform(0.45, 0.65))
    body = random_fruit(rng, float(rng.uniform(0.15, 0.3)))
    at_m = (-STEP_M * (places - 1) / 2, 0.0, far_m)
    fruit = place_hanging(body, at_m, tilt_deg=float(rng.uniform(0, 25)))
    scene = occlude(trellis(rng, CAMERA, (fruit,)), CAMERA, 0, float(rng.uniform(0, 0.3)), rng)
    options = MeasureOptions(instances="dataset", segmenter="none", methods=(Method.M3, Method.M6))
    stream = FruitStream(Measurer(options))
    lengths: list[Length | None] = []
    tracks: set[int] = set()
    for k in range(places):
        moved = scene.moved(np.eye(3), np.array([STEP_M * k, 0.0, 0.0]))
        (truth,) = truth_of(moved, CAMERA, render(moved, CAMERA))
        mask = disturb_mask(
            truth.visible, draw_disturbance(truth.visible.shape, OUTLINE_RMS_PX, rng)
        )
        for n, depth_m in enumerate(sense(moved, camera, rng, frames=frames)):
            stamp = 1e9 + (k * frames + n) / FPS
            color = np.zeros((*mask.shape, 3), np.uint8)
            capture = Capture(
                color, depth_m, CAMERA, "drawn", masks=(mask,), timestamp_s=stamp, simulated=True
            )
            seen = stream.take(capture).fruit
            tracks |= {one.track for one in seen}
            lengths.append(seen[0].length if seen else None)
    return truth.thread_m, lengths, len(tracks)


def main() -> None:
    """Print how often the truth lies within, and how wide the intervals are."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--fruit", type=int, default=150)
    parser.add_argument("--places", type=int, default=5)
    parser.add_argument("--frames", type=int, default=3)
    chosen = parser.parse_args()
    passed = [pass_by(seed, chosen.places, chosen.frames) for seed in range(chosen.fruit)]
    print(f"{'after':24} {'fruit':>6} {'within 90 %':>12} {'width, %':>9} {'mean error, %':>14}")
    moments = {
        "the first frame": 0,
        f"{chosen.frames} frames, one place": chosen.frames - 1,
        f"all tracks, {chosen.places} places": -1,
    }
    for name, at in moments.items():
        known = [
            (true_m, one)
            for true_m, lengths, _ in passed
            if (one := lengths[at]) is not None
            and one.kind == LengthDefinition.THREAD
            and one.low_m is not None
            and one.high_m is not None
        ]
        inside = [one.low_m <= true_m <= one.high_m for true_m, one in known]
        width = [(one.high_m - one.low_m) / one.value_m for _, one in known]
        error = [abs(one.value_m / true_m - 1) for true_m, one in known]
        print(
            f"{name:24} {len(known):6} {100 * np.mean(inside):10.0f} % {100 * np.mean(width):9.1f} "
            f"{100 * np.mean(error):14.2f}"
        )
    print(f"{sum(count == 1 for *_, count in passed)} of {len(passed)} fruit kept one number")


if __name__ == "__main__":
    main()
