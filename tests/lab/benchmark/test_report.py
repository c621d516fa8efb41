from __future__ import annotations

import json
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import pytest

from cucumbervision.errors import CucumberVisionError
from cucumbervision_lab.benchmark.cases import Suite
from cucumbervision_lab.benchmark.records import Masks, readings_frame

pytest.importorskip("matplotlib")
pytest.importorskip("jinja2")

from tests.lab.benchmark.conftest import make_record

from cucumbervision_lab.benchmark.report import write_benchmark_report

if TYPE_CHECKING:
    from pathlib import Path

    from tests.lab.benchmark.conftest import MakeRecord


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


@pytest.fixture
def numbers(make_record: MakeRecord, tmp_path: Path) -> dict[str, Any]:
    page = write_benchmark_report(records_of(make_record), tmp_path / "new")
    assert page.stat().st_size > 30_000  # tables and plots
    found: dict[str, Any] = json.loads((tmp_path / "new/benchmark.json").read_text("utf-8"))
    return found


def test_a_section_each_suite_and_kind_of_masks(numbers: dict[str, Any]) -> None:
    assert [section["title"] for section in numbers["sections"]] == [
        "Beside the paper",
        "The paper's protocol, exact outlines",
        "The five validation fruit, exact outlines",
        "The stress set, outlines disturbed by 1.5 px",
    ]
    assert [row["measurements"] for row in numbers["glance"]["rows"]] == [12, 2, 12]
    assert numbers["notes"][0].startswith("Every capture is simulated")


def test_each_suite_has_its_own_tables(numbers: dict[str, Any]) -> None:
    tables = {
        (section["title"], table["title"]): table["rows"]
        for section in numbers["sections"]
        for table in section["tables"]
    }
    rows = tables["The paper's protocol, exact outlines", "Accuracy against the centreline"]
    m5 = next(row for row in rows if row["method"] == "M5")
    assert (m5["captures"], m5["fruit"]) == (12, 4)
    stress = "The stress set, outlines disturbed by 1.5 px"
    assert (stress, "By tilt (°), against the centreline") in tables


def test_nothing_to_report_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CucumberVisionError, match="nothing to report"):
        write_benchmark_report(pd.DataFrame(), tmp_path / "out")
    assert not (tmp_path / "out").exists()
