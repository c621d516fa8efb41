"""M6 alone on the benchmark's stress set: its errors by mask, tilt, distance and what is hidden.

    python benchmarks/stress_m6.py --fruit 400 [--worst 15] [--keep FILE]

Errors of the centreline in percent, and what the 90 % intervals hold, depth scale known and
unknown. Fruit of which leaves hide an end stand apart: what is measured of them is a lower bound.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from resuming import rows_of
from rich.console import Console
from rich.table import Table

from cucumbervision.accuracy.records import Masks
from cucumbervision.measurement.intervals import (
    SCALE_SD,
    WIDEST,
    shipped_interval_models,
    tube_features,
)
from cucumbervision.measurement.m6 import measure_m6
from cucumbervision.measurement.result import Flag
from cucumbervision_lab.benchmark import measure_case
from cucumbervision_lab.benchmark.cases import simulate, stress_cases


def measured(number: int) -> list[dict[str, Any]]:
    """Measure one fruit with exact and with disturbed outlines."""
    (case,) = stress_cases(1, first=number)
    taken = simulate(case)
    truth = taken.truth
    if np.count_nonzero(truth.visible) < measure_case.NO_RECORD_BELOW_PX:
        return []
    rng = np.random.default_rng(case.capture_seed + 4)
    field = measure_case.draw_disturbance(truth.visible.shape, measure_case.OUTLINE_RMS_PX, rng)
    masks = {
        Masks.EXACT: truth.visible,
        Masks.DISTURBED: measure_case.disturb_mask(truth.visible, field),
    }
    run = truth.axis_m[-1] - truth.axis_m[0]
    known = {
        "tilt": float(np.rad2deg(np.arcsin(abs(run[2]) / np.linalg.norm(run)))),
        "hidden": truth.hidden_share,
        "far": case.distance_m,
        "ends": bool(measure_case._ends_seen(taken)),
    }
    rows = []
    for kind, mask in masks.items():
        one = measure_m6(taken.capture.depth_m, mask, taken.capture.intrinsics)
        row = {"masks": str(kind), "number": number, "true_m": truth.centreline_m, **known}
        row |= {"length_m": one.length_m, "scale": taken.depth_scale, "flags": [], "features": {}}
        if one.fit is not None:
            row |= {"flags": list(one.fit.flags), "features": tube_features(one)}
        rows.append(row)
    return rows


ERROR_HEADS = ("masks", "fruit", "count", "none", "mean", "median", "95 % below", "worst", "bias")


def error_table(rows: pd.DataFrame) -> Table:
    """Return the errors by group."""
    table = Table(title="M6 on the stress set: errors of the centreline, %")
    for head in ERROR_HEADS:
        table.add_column(head, justify="right")
    doubt = {Flag.END_HIDDEN, Flag.END_ON, Flag.POOR_FIT, Flag.UNCERTAIN}
    for masks, own in rows.groupby("masks", sort=False):
        seen = own[own["ends"]]
        sure = seen["flags"].map(lambda flags: doubt.isdisjoint(map(Flag, flags)))
        groups = {
            "all": own,
            "ends seen": seen,
            "of these even numbers": seen[seen["number"] % 2 == 0],
            "odd numbers": seen[seen["number"] % 2 == 1],
            "no end taken for hidden": seen[~seen["flags"].map(lambda f: Flag.END_HIDDEN in f)],
            "M6 doubts nothing": seen[sure & seen["error"].notna()],
            "tilt below 15": seen[seen["tilt"] < 15],
            "tilt 15 to 30": seen[seen["tilt"].between(15, 30)],
            "tilt 30 to 60": seen[seen["tilt"] > 30],
            "20 to 40 % hidden": seen[seen["hidden"].between(0.2, 0.4)],
            "beyond 0.8 m": seen[seen["far"] > 0.8],
        }
        for name, some in groups.items():
            size = some["error"].abs()
            figures = (size.mean(), size.median(), size.quantile(0.95), size.max())
            cells = [f"{x:.2f}" for x in (*figures, some["error"].median())]
            table.add_row(str(masks), name, str(len(some)), str(some["error"].isna().sum()), *cells)
    return table


def interval_table(rows: pd.DataFrame) -> Table:
    """Return coverage and width of the 90 % intervals of fruit whose ends are seen, by group."""
    seen = rows[rows["ends"] & rows["length_m"].notna()]
    groups = {
        "all": seen,
        "no end taken for hidden": seen[~seen["flags"].map(lambda f: Flag.END_HIDDEN in f)],
        "exact outlines": seen[seen["masks"] == Masks.EXACT],
        "disturbed outlines": seen[seen["masks"] == Masks.DISTURBED],
        "tilt below 30": seen[seen["tilt"] < 30],
        "tilt 30 to 60": seen[seen["tilt"] >= 30],
        "nearer than 0.75 m": seen[seen["far"] < 0.75],
        "farther": seen[seen["far"] >= 0.75],
        "no leaf before it": seen[seen["hidden"] <= 0],
        "behind a leaf": seen[seen["hidden"] > 0],
    }
    table = Table(title="90 % intervals: what they hold and how wide they are, %")
    for head in (
        "scale",
        "fruit",
        "readings",
        "not given",
        "covered",
        "mean width",
        "median width",
    ):
        table.add_column(head, justify="right")
    model = shipped_interval_models().models["M6"]
    for scale, sd in (("known", 0.0), ("unknown", SCALE_SD)):
        for name, some in groups.items():
            if some.empty:
                continue
            read = some["length_m"] * (some["scale"] if sd else 1.0)
            ends = [model.interval(x, f, sd) for x, f in zip(read, some["features"], strict=True)]
            low, high = np.array(ends).T
            given = high <= WIDEST * low
            some, read, low, high = some[given], read[given], low[given], high[given]
            held = 100 * ((low <= some["true_m"]) & (some["true_m"] <= high)).mean()
            wide = 100 * (high - low) / read
            cells = [f"{x:.1f}" for x in (held, wide.mean(), wide.median())]
            table.add_row(scale, name, str(len(some)), str(int((~given).sum())), *cells)
    return table


def worst_table(rows: pd.DataFrame, count: int) -> Table:
    """Return the fruit with the largest errors, ends seen."""
    table = Table(title="The largest errors")
    heads = ("masks", "number", "error %", "true cm", "tilt", "far m", "hidden %", "holes %")
    for head in heads:
        table.add_column(head, justify="right")
    table.add_column("flags")
    for masks, own in rows[rows["ends"]].groupby("masks", sort=False):
        order = own["error"].abs().sort_values(ascending=False).index[:count]
        for _, row in own.loc[order].iterrows():
            holes = 100 * row["features"].get("holes", np.nan)
            cells = (100 * row["true_m"], row["tilt"], row["far"], 100 * row["hidden"], holes)
            table.add_row(
                str(masks),
                str(row["number"]),
                f"{row['error']:+.1f}",
                *(f"{x:.{2 if k == 2 else 1}f}" for k, x in enumerate(cells)),
                ", ".join(row["flags"]),
            )
    return table


def main() -> None:
    """Print the errors by group."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--fruit", type=int, default=400)
    parser.add_argument("--worst", type=int, default=0)
    parser.add_argument("--keep", type=Path, help="file of what was measured: a run resumes")
    options = parser.parse_args()
    rows = rows_of(options.fruit, measured, options.keep)
    rows["error"] = 100 * (rows["length_m"].astype(float) / rows["true_m"] - 1)
    console = Console(width=120, highlight=False)
    console.print(error_table(rows))
    console.print(interval_table(rows))
    if options.worst:
        console.print(worst_table(rows, options.worst))


if __name__ == "__main__":
    main()
