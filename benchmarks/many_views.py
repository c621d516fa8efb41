"""What further views of a fruit are worth: drawn fruit, each from three stops of a row.

    python benchmarks/many_views.py --fruit 60

A fruit hangs at 0.5 to 0.9 m and tilts by 15 degrees (one standard deviation), six in ten behind
leaves; the stops are 0.3 m apart, known to 3 cm and 1 degree; outlines are disturbed by 1.5 px in
each view anew. The best view is the one that rounds keep. 'Combined' weighs the views' lengths by
their intervals (`rounds.row_fruit.combined_length`), 'one tube' is `measurement.views`.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from time import process_time
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table
from scipy.spatial.transform import Rotation

from cucumbervision.capture.frames import median_depth
from cucumbervision.measurement.m6 import measure_m6
from cucumbervision.measurement.result import Flag
from cucumbervision.measurement.views import FruitView, measure_views
from cucumbervision.rounds.row_fruit import combined_length
from cucumbervision_lab.benchmark.cases import CAMERA, build_scene, stress_cases
from cucumbervision_lab.benchmark.measure_case import disturb_mask, draw_disturbance
from cucumbervision_lab.synthesis.depth_camera import D4xx, sense
from cucumbervision_lab.synthesis.scene import render

if TYPE_CHECKING:
    from cucumbervision.measurement.result import Measurement
    from cucumbervision_lab.benchmark.cases import Case

FIRST = 800_000
SPACING_M, PLACE_SD_M, TURN_SD_DEG = 0.3, 0.03, 1.0
LEAST_PX = 200


def drawn_case(number: int) -> Case:
    """Draw a fruit as it hangs in a row."""
    (case,) = stress_cases(1, first=FIRST + number)
    rng = np.random.default_rng(FIRST + number)
    near = max(0.5, case.length_m * 1.5)
    return replace(
        case,
        tilt_deg=float(np.clip(rng.normal(0, 15), -50, 50)),
        roll_deg=float(rng.normal(-90, 15)),
        distance_m=float(rng.uniform(near, max(near, 0.9))),
        hidden_share=min(case.hidden_share, 0.4),
        hidden_end=False,
        condition="plain",
    )


def drawn_views(case: Case) -> tuple[float, list[FruitView]]:
    """Return the true centreline, and the fruit from the middle stop and those beside it."""
    scene = build_scene(case)
    views = []
    for k in (0, -1, 1):
        rng = np.random.default_rng([case.capture_seed, k + 5])
        seen = scene.moved(np.eye(3), np.array([-k * SPACING_M, 0.0, 0.0]))
        mask = render(seen, CAMERA).mask(0)
        mask = disturb_mask(mask, draw_disturbance(mask.shape, 1.5, rng))
        if np.count_nonzero(mask) < LEAST_PX:
            continue
        depth = median_depth(sense(seen, D4xx.like(CAMERA), rng, 3))
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_rotvec(np.deg2rad(rng.normal(0, TURN_SD_DEG, 3))).as_matrix()
        pose[:3, 3] = np.array([k * SPACING_M, 0.0, 0.0]) + rng.normal(0, PLACE_SD_M, 3)
        views.append(FruitView(depth, mask, CAMERA, pose))
    return scene.fruit[0].centreline_m, views


def relative_sd(one: Measurement) -> float:
    """Return the relative deviation of a single view's length, with a floor for its outline."""
    if one.fit is None or one.length_m is None:
        return np.nan
    return float(np.hypot(one.fit.centreline_sd_m / one.length_m, 0.01))


def errors_of(number: int) -> dict[str, float] | None:
    """Measure one fruit in every way; relative errors in percent, and milliseconds."""
    true_m, views = drawn_views(drawn_case(number))
    alone = [measure_m6(view.depth_m, view.mask, view.intrinsics) for view in views]
    fits = {k: one.fit for k, one in enumerate(alone) if one.fit is not None}
    good = list(fits)
    whole = [k for k, fit in fits.items() if Flag.END_HIDDEN not in fit.flags]
    if len(views) < 3 or len(good) < 3:
        return None
    found: dict[str, float] = {}
    for count in (1, 2, 3):
        some = good[:count]
        seen = [k for k in some if k in whole] or some
        best = min(seen, key=lambda k: relative_sd(alone[k]))
        lengths = np.array([fits[k].traits.lengths.centreline_m for k in seen])
        sds = np.array([relative_sd(alone[k]) for k in seen])
        combined = combined_length(lengths, sds, np.zeros(len(seen), bool))
        start = process_time()
        one = measure_views([views[k] for k in some])
        found[f"ms {count}"] = 1e3 * (process_time() - start)
        found[f"best {count}"] = 100 * (fits[best].traits.lengths.centreline_m / true_m - 1)
        found[f"combined {count}"] = 100 * ((combined or (np.nan,))[0] / true_m - 1)
        found[f"one tube {count}"] = 100 * ((one.length_m or np.nan) / true_m - 1)
        sd = np.nan
        if one.fit is not None and one.length_m is not None:
            sd = one.fit.centreline_sd_m / one.length_m
        found[f"z {count}"] = found[f"one tube {count}"] / 100 / sd
    return found


def main() -> None:
    """Print the errors by number of views."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--fruit", type=int, default=60)
    rows = [errors_of(k) for k in track(range(parser.parse_args().fruit), "fruit")]
    kept = [row for row in rows if row]
    table = Table(title=f"{len(kept)} fruit seen from three stops: error of the centreline, %")
    for head in ("views", "way", "mean", "median", "90 % below", "bias", "of the best view's"):
        table.add_column(head, justify="right")
    for count in (1, 2, 3):
        usual = np.mean([abs(row[f"best {count}"]) for row in kept])
        for way in ("best", "combined", "one tube"):
            off = np.array([row[f"{way} {count}"] for row in kept])
            size = np.abs(off)
            figures = (size.mean(), np.median(size), np.quantile(size, 0.9), np.median(off))
            cells = [f"{x:.2f}" for x in (*figures, size.mean() / usual)]
            table.add_row(str(count), way, *cells)
    Console(width=100, highlight=False).print(table)
    for count in (1, 2, 3):
        z = np.array([row[f"z {count}"] for row in kept])
        spread, ms = 1.4826 * np.nanmedian(abs(z)), np.median([row[f"ms {count}"] for row in kept])
        print(f"{count} views: error over stated sd {spread:.2f} (1 is right), {ms:.0f} ms")


if __name__ == "__main__":
    main()
