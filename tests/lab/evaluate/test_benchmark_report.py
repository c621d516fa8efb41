from __future__ import annotations

import json
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from tests.lab.evaluate.conftest import make_record

from cucumbervision.accuracy.statistics import ReportTable
from cucumbervision_lab.evaluate.benchmark_report import benchmark_tables, write_tables
from cucumbervision_lab.evaluate.cases import Suite
from cucumbervision_lab.evaluate.measure_case import Masks, readings_frame

if TYPE_CHECKING:
    from pathlib import Path

    from tests.lab.evaluate.conftest import MakeRecord


__all__ = ["make_record"]  # the fixture


def records_of(make_record: MakeRecord) -> pd.DataFrame:
    rng = np.random.default_rng(0)
    records = []
    for k in range(12):
        true = float(rng.uniform(0.08, 0.25))
        near = {
            m: true * float(rng.normal(1, sd))
            for m, sd in (("M1", 0.1), ("M5", 0.05), ("M6", 0.01))
        }
        records.append(
            make_record(
                f"p{k}",
                fruit=f"f{k % 4}",
                centreline_m=true,
                thread_m=1.1 * true,
                chord_m=None,
                tilt_deg=5.0 * k,
                lengths_m={**near, "M6 thread": 1.1 * near["M6"]},
            )
        )
    stress = [
        replace(r, suite=Suite.STRESS, masks=Masks.DISTURBED, hidden_share=0.05 * k)
        for k, r in enumerate(records)
    ]
    validation = [replace(r, suite=Suite.VALIDATION) for r in records[:2]]
    return readings_frame([*records, *stress, *validation])


def test_tables_of_each_suite_and_kind_of_masks(make_record: MakeRecord) -> None:
    tables = {table.title: table for table in benchmark_tables(records_of(make_record))}
    assert next(iter(tables)) == "The paper's figures, on its own captures, beside this program's"
    assert list(dict.fromkeys(title.split(": ")[0] for title in tables if ": " in title)) == [
        "The paper's protocol, exact outlines",
        "The five validation fruit, exact outlines",
        "The stress set, outlines disturbed by 1.5 px",
    ]
    accuracy = tables["The paper's protocol, exact outlines: Accuracy against the centreline"]
    m5 = next(row for row in accuracy.rows if row[0] == "M5")
    assert m5[1:3] == (12, 4)  # captures, fruit
    stress = "The stress set, outlines disturbed by 1.5 px"
    assert f"{stress}: By tilt (°), against the centreline" in tables
    # Two captures are too few for groups.
    assert not any(
        title.startswith("The five validation fruit, exact outlines: By") for title in tables
    )


def test_tables_are_written_with_unrounded_numbers(tmp_path: Path) -> None:
    table = ReportTable.of("Bursts", ["frames", "MAPE (%):.1"], [[5, 0.123], [1, float("nan")]])
    path = write_tables(tmp_path / "new" / "benchmark.json", {"stress fruit": 3}, [table])
    assert json.loads(path.read_text("utf-8")) == {
        "stress fruit": 3,
        "tables": [
            {
                "title": "Bursts",
                "comment": "",
                "rows": [{"frames": 5, "MAPE (%)": 0.123}, {"frames": 1, "MAPE (%)": None}],
            }
        ],
    }
