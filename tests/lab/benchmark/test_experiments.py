from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from cucumbervision_lab.benchmark.cases import Suite
from cucumbervision_lab.benchmark.experiments import (
    burst_sizes,
    carrot_intrinsics,
    length_conventions,
    sam_prompts,
    selectors,
    wrong_intrinsics,
)
from cucumbervision_lab.report.records import LengthRecord, Masks, readings_frame


def record(**changes: object) -> LengthRecord:
    values: dict[str, object] = {
        "case": "c", "suite": Suite.PAPER, "masks": Masks.EXACT, "fruit": "f",
        "centreline_m": 0.2, "thread_m": 0.22, "chord_m": 0.19, "distance_m": 0.5,
        "tilt_deg": 0.0, "bend_radius_m": None, "hidden_share": 0.0, "fill": 1.0,
        "lengths_m": {"M3": 0.19, "M5": 0.21, "M6": 0.2, "selector best": 0.2,
                      "selector paper": 0.21},
        "details": {"mask_iou": 0.95, "mask_failure": ""},
    }  # fmt: skip
    return LengthRecord(**(values | changes))  # type: ignore[arg-type]


def test_the_axis_errs_by_the_formula() -> None:
    rows = wrong_intrinsics().rows
    assert len(rows) == 20
    for _, tilt, formula, axis, _ in rows:
        assert axis == pytest.approx(formula, abs=0.15), tilt
    # By hand, D435: 910.22 / 640 - 1, and sqrt(k² cos² 60 + sin² 60) - 1.
    k = 910.22 / 640
    assert rows[0][2] == pytest.approx(100 * (k - 1), abs=0.06)
    assert rows[4][2] == pytest.approx(100 * (np.sqrt(k**2 / 4 + 0.75) - 1), abs=0.06)


@pytest.mark.realdata
def test_the_carrot_reads_45_percent_long(shared_data: Path) -> None:
    frames, mean, spread, formula = carrot_intrinsics(
        shared_data / "rgbd/carrot_realsense_1280"
    ).rows[0]
    assert (frames, formula) == (10, 44.9)
    assert mean == pytest.approx(44.9, abs=1.5)
    assert float(str(spread)) < 2


def test_bursts_are_scored_by_size() -> None:
    asked: list[int] = []

    def measure(size: int) -> pd.DataFrame:
        asked.append(size)
        return readings_frame([record()])

    table = burst_sizes(measure, sizes=(1, 5))
    assert asked == [1, 5]
    assert table.rows == ((1, 1, 5.0, 5.0, 0.0), (5, 1, 5.0, 5.0, 0.0))


def test_prompts_count_refused_masks() -> None:
    def measure(prompt: str) -> pd.DataFrame:
        refused = record(
            case="d",
            lengths_m={"M6": None},
            details={"mask_iou": 0.0, "mask_failure": "mask-small" if prompt == "point" else ""},
        )
        return readings_frame([record(), refused])

    rows = {row[0]: row[1:] for row in sam_prompts(measure).rows}
    assert rows["box"] == (2, 0, 0.475, 50.0)
    assert rows["point"] == (2, 1, 0.475, 50.0)


def test_selectors_are_compared_by_masks() -> None:
    rows = selectors(readings_frame([record(), record(suite=Suite.STRESS)])).rows
    assert rows == (("paper", "exact", 1, 5.0), ("best", "exact", 1, 0.0))


def test_conventions_count_each_fruit_once() -> None:
    rows = length_conventions(readings_frame([record(), record(case="again")])).rows
    assert rows == (("18 to 45 cm", 1, 10.0, -5.0),)
