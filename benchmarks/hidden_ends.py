"""Fruit with one end hidden by a leaf: M6's estimate of the whole length, and its interval.

    python benchmarks/hidden_ends.py --fruit 110

Fruit of the stress set's kind (0.3 to 1.2 m, tilted up to 45 degrees, outlines exact and
disturbed), a leaf laid over 7 to 45 % of each from one end, and over 0 to 12 cm beyond it.
"""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from rich.console import Console
from rich.progress import track
from rich.table import Table

from cucumbervision.measurement.m6 import measure_m6
from cucumbervision_lab.benchmark.cases import simulate, stress_cases
from cucumbervision_lab.benchmark.measure_case import (
    OUTLINE_RMS_PX,
    disturb_mask,
    draw_disturbance,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

FIRST = 500_000
MOST_TILT_DEG, MOST_HIDDEN = 45.0, 0.3
NEARER_M, HALF_LEAF_M, BEYOND_M = 0.05, 0.06, 0.12


def leaf_over(
    axis_px: NDArray[np.float64], beyond_px: float, half_px: float, shape: tuple[int, int]
) -> NDArray[np.bool_]:
    """Return the pixels of a leaf from the first of two points over the second and beyond."""
    run = axis_px[1] - axis_px[0]
    length_px = float(np.hypot(*run))
    v, u = np.indices(shape)
    off = np.stack([u - axis_px[0, 0], v - axis_px[0, 1]], axis=-1) / length_px
    along, across = off @ run, off @ np.array([-run[1], run[0]])
    over = (along > 0) & (along < length_px + beyond_px) & (np.abs(across) < half_px)
    return np.asarray(over, np.bool_)


def measured(number: int) -> list[dict[str, Any]]:
    """Measure one fruit behind its leaf, with both kinds of outline."""
    (case,) = stress_cases(1, first=FIRST + number)
    if case.hidden_end or case.hidden_share >= MOST_HIDDEN or abs(case.tilt_deg) > MOST_TILT_DEG:
        return []
    taken, rng = simulate(case), np.random.default_rng(number)
    camera, axis = taken.capture.intrinsics, taken.truth.axis_m
    axis = axis[::-1] if rng.random() < 0.5 else axis
    share = rng.uniform(0.55, 0.93)
    pixel = camera.fx_px / axis[-1, 2]
    ends = camera.project(axis[[int(share * len(axis)), -1]])
    shape = taken.truth.visible.shape
    leaf = leaf_over(ends, rng.uniform(0, BEYOND_M) * pixel, HALF_LEAF_M * pixel, shape)
    depth = taken.capture.depth_m.copy()
    depth[leaf] = axis[:, 2].min() - NEARER_M
    exact = taken.truth.visible & ~leaf
    field = draw_disturbance(exact.shape, OUTLINE_RMS_PX, rng)
    rows = []
    for kind, mask in (("exact", exact), ("disturbed", disturb_mask(exact, field) & ~leaf)):
        fit = measure_m6(depth, mask, camera).fit
        if fit is not None:
            row = {"kind": kind, "share": share, "true": taken.truth.centreline_m}
            row |= {"seen": fit.traits.lengths.centreline_m, "flagged": not all(fit.ends_seen)}
            estimate = fit.hidden_length
            row["median"] = np.nan if estimate is None else estimate.median_m
            row["low"] = np.nan if estimate is None else estimate.low_m
            row["high"] = np.nan if estimate is None else estimate.high_m
            rows.append(row)
    return rows


def main() -> None:
    """Print error and coverage by group."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--fruit", type=int, default=110)
    fruit = track(range(parser.parse_args().fruit), "fruit")
    rows = pd.DataFrame([row for number in fruit for row in measured(number)])
    estimated = rows[rows["median"].notna()]
    groups = {
        "all": estimated["true"] > 0,
        "exact outlines": estimated["kind"] == "exact",
        "disturbed outlines": estimated["kind"] == "disturbed",
        "7 to 25 % hidden": estimated["share"] >= 0.75,
        "25 to 45 % hidden": estimated["share"] < 0.75,
    }
    title = (
        f"{len(rows)} measured, {rows['flagged'].sum()} flagged, {len(estimated)} with an estimate"
    )
    table = Table(title=title)
    heads = (
        "group",
        "readings",
        "seen, median %",
        "median off %",
        "error %",
        "covers %",
        "width %",
    )
    for head in heads:
        table.add_column(head, justify="right")
    for name, chosen in groups.items():
        readings = estimated[chosen]
        error_percent = 100 * (readings["median"] / readings["true"] - 1)
        covers = 100 * readings["true"].between(readings["low"], readings["high"]).mean()
        width = 100 * ((readings["high"] - readings["low"]) / readings["median"]).mean()
        seen_percent = 100 * (readings["seen"] / readings["true"] - 1).median()
        cells = (seen_percent, error_percent.median(), error_percent.abs().mean(), covers, width)
        table.add_row(name, str(len(readings)), *(f"{x:.1f}" for x in cells))
    Console(width=100, highlight=False).print(table)


if __name__ == "__main__":
    main()
