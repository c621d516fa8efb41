"""Errors of one, two and three views together: drawn fruit, each seen from three stops of a row.

    python benchmarks/many_views.py --fruit 140 [--perceived]

A fruit hangs at 0.5 to 0.9 m and tilts by 15 degrees (one standard deviation), six in ten behind
leaves; the stops are 0.3 m apart. Outlines are disturbed by 1.5 px in
each view anew, or with --perceived found and drawn by the networks in painted pictures. The best
view is the one of the narrowest interval, 'pooled' weighs the views' lengths by their intervals
(`measurement.matching.pooled_length`), as rounds do. Coverage is that of the 90 % interval, depth
scale known.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from cucumbervision.capture.frames import Capture, median_depth
from cucumbervision.fruit.instance import Instance, MaskSource
from cucumbervision.fruit.masks import box_of_mask
from cucumbervision.methods.matching import pooled_length
from cucumbervision.methods.result import INTERVAL_Z, LengthDefinition, MethodName, Selector
from cucumbervision.methods.selector import measure_fruit
from cucumbervision.run.finders import make_finder
from cucumbervision.run.options import MeasureOptions
from cucumbervision_lab.evaluate.cases import CAMERA, build_scene, paint_scene, stress_cases
from cucumbervision_lab.evaluate.measure_case import disturb_mask, draw_disturbance, found_at
from cucumbervision_lab.scenes.depth_camera import D4xx, sense
from cucumbervision_lab.scenes.scene import render

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from cucumbervision.methods.result import Fruit
    from cucumbervision_lab.evaluate.cases import Case

    Find = Callable[[Capture], Sequence[Instance]]

FIRST = 800_000
SPACING_M = 0.3
LEAST_PX = 200
CENTRELINE = LengthDefinition.CENTRELINE


def drawn_case(number: int) -> Case:
    """Draw a fruit as it hangs in a row."""
    (case,) = stress_cases(1, first=FIRST + number)
    rng = np.random.default_rng(FIRST + number)
    nearest_m = max(0.5, case.length_m * 1.5)
    return replace(
        case,
        tilt_deg=float(np.clip(rng.normal(0, 15), -50, 50)),
        roll_deg=float(rng.normal(-90, 15)),
        distance_m=float(rng.uniform(nearest_m, max(nearest_m, 0.9))),
        hidden_share=min(case.hidden_share, 0.4),
        hidden_end=False,
        condition="plain",
    )


def drawn_views(case: Case, find: Find | None) -> tuple[float, list[tuple[Capture, Instance]]]:
    """Return the true centreline, and the fruit from the middle stop and those beside it."""
    scene = build_scene(case)
    views = []
    for k in (0, -1, 1):
        rng = np.random.default_rng([case.capture_seed, k + 5])
        moved_scene = scene.moved(np.eye(3), np.array([-k * SPACING_M, 0.0, 0.0]))
        drawn = render(moved_scene, CAMERA)
        mask = drawn.mask(0)
        if np.count_nonzero(mask) < LEAST_PX:
            continue
        depth = median_depth(sense(moved_scene, D4xx.like(CAMERA), rng, 3))
        if find is None:
            mask = disturb_mask(mask, draw_disturbance(mask.shape, 1.5, rng))
            fruit = Instance(box_of_mask(mask), mask=mask, mask_source=MaskSource.DATASET)
        else:
            color = paint_scene(moved_scene, drawn, np.random.default_rng(case.capture_seed + 2))
            instance = found_at(box_of_mask(mask), find(Capture(color, depth, CAMERA, "drawn")))
            if instance is None or instance.mask is None:
                continue
            fruit, mask = instance, instance.mask
        capture = Capture(np.zeros((*mask.shape, 3), np.uint8), depth, CAMERA, "drawn")
        views.append((capture, fruit))
    return scene.fruit[0].centreline_m, views


def figures(fruit: Fruit | None) -> tuple[float, float, float, bool] | None:
    """Return a fruit's length and interval, and whether it is shown whole; None without them."""
    length = None if fruit is None else fruit.length
    if fruit is None or length is None or length.low_m is None or length.high_m is None:
        return None
    return length.value_m, length.low_m, length.high_m, not fruit.at_least


def measured(number: int, find: Find | None) -> dict[str, Any]:
    """Measure one fruit from each stop alone."""
    true_m, views = drawn_views(drawn_case(number), find)
    alone = [
        figures(measure_fruit(*view, (MethodName.M6,), Selector.BEST, CENTRELINE, scale_known=True))
        for view in views
    ]
    return {"true_m": true_m, "alone": [view for view in alone if view is not None]}


def errors_of(row: dict[str, Any]) -> dict[str, float] | None:
    """Return a fruit's errors in percent by number of views and way, and what intervals hold."""
    if len(row["alone"]) < 3:
        return None
    true_m, errors = row["true_m"], {}
    for count in (1, 2, 3):
        views = row["alone"][:count]
        views = [view for view in views if view[3]] or views  # as rounds do
        lengths, lower_m, upper_m = np.array([view[:3] for view in views]).T
        sds = np.log(upper_m / lower_m) / (2 * INTERVAL_Z)
        combined, sd_m = pooled_length(lengths, sds, np.zeros(len(views), bool)) or (0.0, 0.0)
        spread = float(np.exp(INTERVAL_Z * sd_m / combined))
        best = int(np.argmin(sds))
        ways = {
            "best": (lengths[best], lower_m[best], upper_m[best]),
            "pooled": (combined, combined / spread, combined * spread),
        }
        for way, (length, lower, upper) in ways.items():
            errors[f"{way} {count}"] = 100 * (length / true_m - 1)
            errors[f"{way} {count} covers"] = lower < true_m < upper
            errors[f"{way} {count} width"] = 100 * (upper - lower) / length
    return errors


def main() -> None:
    """Print the errors by number of views."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--fruit", type=int, default=60)
    parser.add_argument("--perceived", action="store_true")
    options = parser.parse_args()
    finder = make_finder(MeasureOptions(instances="models")) if options.perceived else None
    find = None if finder is None else lambda capture: finder.find(capture).instances
    rows = [measured(k, find) for k in track(range(options.fruit), "fruit")]
    views = np.bincount([len(row["alone"]) for row in rows], minlength=4)
    print("views of a fruit that were measured:", dict(enumerate(views.tolist())))
    errors = [row for row in map(errors_of, rows) if row]
    table = Table(title=f"{len(errors)} fruit seen from three stops: error of the centreline, %")
    heads = ("views", "way", "mean", "median", "90 % below", "bias", "of the best view's")
    for head in (*heads, "90 % interval covers", "width, %"):
        table.add_column(head, justify="right")
    for count in (1, 2, 3):
        usual = np.mean([abs(row[f"best {count}"]) for row in errors])
        for way in ("best", "pooled"):
            off = np.array([row[f"{way} {count}"] for row in errors])
            size = np.abs(off)
            spread_of = (size.mean(), np.median(size), np.quantile(size, 0.9), np.median(off))
            cells = [f"{x:.2f}" for x in (*spread_of, size.mean() / usual)]
            covers = np.mean([row[f"{way} {count} covers"] for row in errors])
            width = np.mean([row[f"{way} {count} width"] for row in errors])
            table.add_row(str(count), way, *cells, f"{100 * covers:.0f} %", f"{width:.1f}")
    Console(width=110, highlight=False).print(table)


if __name__ == "__main__":
    main()
