"""What further views of a fruit are worth: drawn fruit, each from three stops of a row.

    python benchmarks/many_views.py --fruit 60 [--perceived] [--keep FILE]

A fruit hangs at 0.5 to 0.9 m and tilts by 15 degrees (one standard deviation), six in ten behind
leaves; the stops are 0.3 m apart, known to 3 cm and 1 degree. Outlines are disturbed by 1.5 px in
each view anew, or with --perceived found and drawn by the networks in painted pictures. The best
view is the one of the narrowest interval, 'combined' weighs the views' lengths by their intervals
as rounds do (`rounds.row_fruit.combined_length`), 'one tube' is `measurement.views`. Coverage is
that of the 90 % interval, depth scale known.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from time import process_time
from typing import TYPE_CHECKING, Any

import numpy as np
from resuming import rows_of
from rich.console import Console
from rich.table import Table
from scipy.spatial.transform import Rotation

from cucumbervision.capture.frames import Capture, median_depth
from cucumbervision.measurement.intervals import (
    mask_features,
    shipped_interval_models,
    tube_features,
)
from cucumbervision.measurement.result import Method
from cucumbervision.measurement.selector import measure_fruit
from cucumbervision.measurement.views import FruitView, measure_views
from cucumbervision.perception.instances import Instance, MaskSource
from cucumbervision.perception.masks import box_of_mask
from cucumbervision.pipeline.finders import make_finder
from cucumbervision.pipeline.options import MeasureOptions
from cucumbervision.rounds.from_store import LENGTH_Z
from cucumbervision.rounds.row_fruit import combined_length
from cucumbervision_lab.benchmark.cases import CAMERA, build_scene, paint_scene, stress_cases
from cucumbervision_lab.benchmark.measure_case import disturb_mask, draw_disturbance, found_at
from cucumbervision_lab.synthesis.depth_camera import D4xx, sense
from cucumbervision_lab.synthesis.scene import render

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from cucumbervision_lab.benchmark.cases import Case

    Find = Callable[[Capture], Sequence[Instance]]

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


def drawn_views(case: Case, find: Find | None) -> tuple[float, list[tuple[FruitView, Instance]]]:
    """Return the true centreline, and the fruit from the middle stop and those beside it."""
    scene = build_scene(case)
    views = []
    for k in (0, -1, 1):
        rng = np.random.default_rng([case.capture_seed, k + 5])
        seen = scene.moved(np.eye(3), np.array([-k * SPACING_M, 0.0, 0.0]))
        drawn = render(seen, CAMERA)
        mask = drawn.mask(0)
        if np.count_nonzero(mask) < LEAST_PX:
            continue
        depth = median_depth(sense(seen, D4xx.like(CAMERA), rng, 3))
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_rotvec(np.deg2rad(rng.normal(0, TURN_SD_DEG, 3))).as_matrix()
        pose[:3, 3] = np.array([k * SPACING_M, 0.0, 0.0]) + rng.normal(0, PLACE_SD_M, 3)
        if find is None:
            mask = disturb_mask(mask, draw_disturbance(mask.shape, 1.5, rng))
            fruit = Instance(box_of_mask(mask), mask=mask, mask_source=MaskSource.DATASET)
        else:
            color = paint_scene(seen, drawn, np.random.default_rng(case.capture_seed + 2))
            found = found_at(box_of_mask(mask), find(Capture(color, depth, CAMERA, "drawn")))
            if found is None or found.mask is None:
                continue
            fruit, mask = found, found.mask
        views.append((FruitView(depth, mask, CAMERA, pose), fruit))
    return scene.fruit[0].centreline_m, views


def measured_alone(view: FruitView, fruit: Instance) -> tuple[float, dict[str, float], bool] | None:
    """Return the length of one view, what its interval rests on, and whether it shows all."""
    dark = np.zeros((*view.mask.shape, 3), np.uint8)
    capture = Capture(dark, view.depth_m, view.intrinsics, "drawn")
    one = measure_fruit(capture, fruit, (Method.M6,))
    if one.fit is None or one.selected is None or one.selected.length_m is None:
        return None
    features = mask_features(one.mask_source, one.flags)
    return one.selected.length_m, tube_features(one.selected) | features, not one.at_least


def measured(number: int, find: Find | None) -> dict[str, Any]:
    """Measure one fruit from each stop alone, and as one tube in the first two and all three."""
    true_m, seen = drawn_views(drawn_case(number), find)
    views = [view for view, _ in seen]
    alone = [measured_alone(*one) for one in seen]
    good = [k for k, one in enumerate(alone) if one is not None]
    found: dict[str, Any] = {"number": number, "true_m": true_m, "alone": [], "one": []}
    found["alone"] = [alone[k] for k in good]
    for count in range(1, len(good) + 1):
        start = process_time()
        joint = measure_views([views[k] for k in good[:count]])
        ms = 1e3 * (process_time() - start)
        one = joint.measurement
        features = None
        if one.fit is not None:
            features = {**alone[good[joint.first]][1], **tube_features(one)}
        found["one"].append((one.length_m, features, ms))
    return found


def errors_of(row: dict[str, Any]) -> dict[str, float] | None:
    """Return a fruit's errors in percent by number of views and way, and what intervals hold."""
    if len(row["alone"]) < 3:
        return None
    book, true_m, found = shipped_interval_models(), row["true_m"], {}
    for count in (1, 2, 3):
        some = row["alone"][:count]
        some = [one for one in some if one[2]] or some  # as rounds do
        lengths = np.array([one[0] for one in some])
        ends = np.array([book.models["M6"].interval(*one[:2]) for one in some])
        sds = np.log(ends[:, 1] / ends[:, 0]) / (2 * LENGTH_Z)
        best = int(np.argmin(sds))
        combined, sd_m = combined_length(lengths, sds, np.zeros(len(some), bool)) or (0.0, 0.0)
        one_m, one_sd_m, ms = row["one"][count - 1]
        found[f"best {count}"] = 100 * (lengths[best] / true_m - 1)
        found[f"combined {count}"] = 100 * (combined / true_m - 1)
        found[f"one tube {count}"] = 100 * ((one_m or np.nan) / true_m - 1)
        found[f"ms {count}"] = ms
        found[f"z {count}"] = (one_m - true_m) / one_sd_m if one_m else np.nan
        spread = LENGTH_Z * sd_m / combined
        found[f"covers {count}"] = abs(np.log(combined / true_m)) < spread
        found[f"width {count}"] = 200 * spread
    return found


def main() -> None:
    """Print the errors by number of views."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--fruit", type=int, default=60)
    parser.add_argument("--perceived", action="store_true")
    parser.add_argument("--keep", type=Path, help="file of what was measured: a run resumes")
    options = parser.parse_args()
    finder = make_finder(MeasureOptions(instances="models")) if options.perceived else None
    find = None if finder is None else lambda capture: finder.find(capture).instances
    rows = rows_of(options.fruit, lambda number: [measured(number, find)], options.keep)
    found = rows.to_dict("records")
    views = np.bincount([len(row["alone"]) for row in found], minlength=4)
    print("views of a fruit that were measured:", dict(enumerate(views.tolist())))
    kept = [row for row in map(errors_of, found) if row]
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
        covers = 100 * np.mean([row[f"covers {count}"] for row in kept])
        width = np.mean([row[f"width {count}"] for row in kept])
        print(f"{count} views combined: interval {width:.1f} % wide, covers {covers:.0f} %")
        spread, ms = 1.4826 * np.nanmedian(abs(z)), np.median([row[f"ms {count}"] for row in kept])
        print(f"{count} views: error over stated sd {spread:.2f} (1 is right), {ms:.0f} ms")


if __name__ == "__main__":
    main()
