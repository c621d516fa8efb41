"""How much of a length's error stays in frames from one place, and how much from place to place.

    python benchmarks/track_noise.py [--fruit 60] [--moves 0.02 0.05 0.1 0.2]

Drawn fruit are taken twice from one place (the two frames share the noise that the simulated D4xx
keeps fixed) and once from places farther along the row, where that noise is new; the outline's
error is drawn once a place. Printed is the correlation of the log errors of M6's centreline with
those of the first frame, and which share of the variance of one frame's error the mean of both
leaves: what `streaming.track_length.FIXED` and `rounds.row_fruit.SHARED` assume.
"""

from __future__ import annotations

import argparse

import numpy as np

from cucumbervision.capture.frames import Capture
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.measurement.result import Method
from cucumbervision.measurement.selector import measure_fruit
from cucumbervision.perception.instances import Instance
from cucumbervision.perception.masks import box_of_mask
from cucumbervision_lab.benchmark.measure_case import (
    OUTLINE_RMS_PX,
    disturb_mask,
    draw_disturbance,
)
from cucumbervision_lab.synthesis.bodies import random_fruit
from cucumbervision_lab.synthesis.depth_camera import D4xx, sense
from cucumbervision_lab.synthesis.placing import occlude, place_hanging, trellis
from cucumbervision_lab.synthesis.scene import render, truth_of

CAMERA = Intrinsics(848, 480, 616.0, 616.0, 424.0, 240.0)


def errors_of_one(seed: int, moves_m: list[float]) -> list[float]:
    """Measure one fruit from all places; log errors, the first place's two frames first."""
    rng = np.random.default_rng(seed)
    camera = D4xx.like(CAMERA)
    far_m = float(rng.uniform(0.45, 0.65))
    body = random_fruit(rng, float(rng.uniform(0.15, 0.3)))
    fruit = place_hanging(body, (-0.08, 0.0, far_m), tilt_deg=float(rng.uniform(0, 25)))
    scene = occlude(trellis(rng, CAMERA, (fruit,)), CAMERA, 0, float(rng.uniform(0, 0.3)), rng)
    errors = []
    for k, move_m in enumerate([0.0, *moves_m]):
        moved = scene.moved(np.eye(3), np.array([move_m, 0.0, 0.0]))
        view = render(moved, CAMERA)
        (truth,) = truth_of(moved, CAMERA, view)
        outline = draw_disturbance(truth.visible.shape, OUTLINE_RMS_PX, rng)
        mask = disturb_mask(truth.visible, outline)
        instance = Instance(box_of_mask(mask), mask=mask)
        for depth_m in sense(moved, camera, rng, frames=1 if k else 2):
            capture = Capture(np.zeros((480, 848, 3), np.uint8), depth_m, CAMERA, "drawn")
            length = measure_fruit(capture, instance, (Method.M6,)).measurements[Method.M6].length_m
            errors.append(np.log(length / truth.centreline_m) if length else np.nan)
    return errors


def main() -> None:
    """Print the correlations."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--fruit", type=int, default=60)
    parser.add_argument("--moves", type=float, nargs="+", default=[0.02, 0.05, 0.1, 0.2])
    options = parser.parse_args()
    errors = np.array([errors_of_one(seed, options.moves) for seed in range(options.fruit)])
    # A fit that failed is another matter than noise.
    errors = errors[(np.abs(errors) < 0.15).all(axis=1)]
    print(f"{len(errors)} of {options.fruit} fruit measured from all places")
    print(f"{'moved by, cm':>12} {'sd, %':>6} {'correlation':>12} {'variance left by two':>21}")
    for k, move_m in enumerate([0.0, *options.moves], start=1):
        first, second = errors[:, 0], errors[:, k]
        both = np.mean([first.var(ddof=1), second.var(ddof=1)])
        shared = float(np.cov(first, second)[0, 1] / both)
        print(
            f"{100 * move_m:12.0f} {100 * second.std(ddof=1):6.2f} {shared:12.2f} "
            f"{(1 + shared) / 2:21.2f}"
        )


if __name__ == "__main__":
    main()
