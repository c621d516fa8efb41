"""M6 alone on the benchmark's stress set: its errors by mask, tilt, distance and what is hidden.

    python benchmarks/stress_m6.py --fruit 190

Errors of the centreline in percent. Fruit of which leaves hide an end stand apart: what is
measured of them is a lower bound.
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np
import pandas as pd
from rich.console import Console
from rich.progress import track
from rich.table import Table

from cucumbervision.accuracy.records import Masks
from cucumbervision.measurement.m6 import measure_m6
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
        "ends": measure_case._ends_seen(taken),
    }
    rows = []
    for kind, mask in masks.items():
        length = measure_m6(taken.capture.depth_m, mask, taken.capture.intrinsics).length_m
        error = np.nan if length is None else 100 * (length / truth.centreline_m - 1)
        rows.append({"masks": str(kind), "error": error, **known})
    return rows


def main() -> None:
    """Print the errors by group."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--fruit", type=int, default=190)
    numbers = track(range(parser.parse_args().fruit), "fruit")
    rows = pd.DataFrame([row for number in numbers for row in measured(number)])
    table = Table(title="M6 on the stress set: errors of the centreline, %")
    for head in (
        "masks",
        "fruit",
        "count",
        "none",
        "mean",
        "median",
        "95 % below",
        "worst",
        "bias",
    ):
        table.add_column(head, justify="right")
    for masks, own in rows.groupby("masks", sort=False):
        seen = own[own["ends"]]
        groups = {
            "all": own,
            "ends seen": seen,
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
    Console(width=110, highlight=False).print(table)


if __name__ == "__main__":
    main()
