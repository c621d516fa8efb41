from __future__ import annotations

import json
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import pytest

from cucumbervision.errors import CucumberVisionError
from cucumbervision.measurement.result import LengthDefinition
from cucumbervision_lab.benchmark.cases import Suite
from cucumbervision_lab.report.length_tables import against
from cucumbervision_lab.report.records import Masks, readings_frame

pytest.importorskip("matplotlib")
pytest.importorskip("jinja2")

from tests.lab.report.conftest import make_record
from tests.lab.report.test_plots import picture, pixels

from cucumbervision_lab.benchmark.report import (
    TILT_EDGES_DEG,
    coverage_by_group,
    coverage_plot,
    coverage_table,
    error_by_value_plot,
    write_benchmark_report,
)

if TYPE_CHECKING:
    from pathlib import Path

    from tests.lab.report.conftest import MakeRecord

    from cucumbervision_lab.report.records import LengthRecord

__all__ = ["make_record"]  # the fixture


def with_interval(records: list[LengthRecord], low_m: Any, high_m: Any) -> pd.DataFrame:
    return readings_frame(records).assign(low_m=low_m, high_m=high_m)


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
                lengths_m={**near, "M6 thread": 1.1 * near["M6"], "oracle": true},
            )
        )
    stress = [
        replace(r, suite=Suite.STRESS, masks=Masks.DISTURBED, hidden_share=0.05 * k)
        for k, r in enumerate(records)
    ]
    validation = [replace(r, suite=Suite.VALIDATION) for r in records[:2]]
    frame = readings_frame([*records, *stress, *validation])
    own = frame["length_m"].where(frame["method"] == "M6")
    return frame.assign(low_m=0.97 * own, high_m=1.03 * own)


@pytest.fixture
def numbers(make_record: MakeRecord, tmp_path: Path) -> dict[str, Any]:
    page = write_benchmark_report(records_of(make_record), tmp_path / "new")
    assert page.stat().st_size > 50_000  # tables and plots
    found: dict[str, Any] = json.loads((tmp_path / "new/benchmark.json").read_text("utf-8"))
    return found


def test_a_section_each_suite_and_kind_of_masks(numbers: dict[str, Any]) -> None:
    assert [section["title"] for section in numbers["sections"]] == [
        "Beside the paper",
        "The paper's protocol, exact outlines",
        "The five validation fruit, exact outlines",
        "The stress set, outlines disturbed by 1.5 px",
    ]
    assert numbers["records"] == 26
    assert [row["measurements"] for row in numbers["glance"]["rows"]] == [12, 2, 12]
    assert {"summary", "paper"} == set(numbers["notes"])


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
    assert (stress, "How often the interval holds the true centreline") in tables
    one_by_one = "Fruit by fruit, against the thread"
    assert ("The five validation fruit, exact outlines", one_by_one) in tables
    assert (stress, one_by_one) not in tables


def test_nothing_to_report_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CucumberVisionError, match="nothing to report"):
        write_benchmark_report(pd.DataFrame(), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_coverage_by_hand(make_record: MakeRecord) -> None:
    # 8 of 10 intervals of +-1 cm around 20 cm hold the truth: width 10 %. Exact binomial interval
    # of 8 of 10: 44.4 to 97.5 % (Clopper and Pearson 1934), which contains 90.
    records = [
        make_record(f"c{k}", condition="sun" if k < 2 else "plain", lengths_m={"M6": 0.2})
        for k in range(10)
    ]
    middle = np.array([0.22, 0.18, *[0.2] * 8])
    groups = coverage_by_group(
        with_interval(records, middle - 0.01, middle + 0.01), LengthDefinition.CENTRELINE
    )
    everything, sun, plain = groups.itertuples()
    assert (everything.captures, everything.hits, everything.as_stated) == (10, 8, True)
    assert (everything.low, everything.high) == pytest.approx((0.444, 0.975), abs=5e-4)
    assert plain.width_percent == pytest.approx(10.0)
    # None of two: the upper limit is 1 - 0.025^(1/2) = 84.2 %, which is below 90.
    assert (sun.group, sun.hits, sun.as_stated) == ("sun", 0, False)
    assert sun.high == pytest.approx(1 - 0.025**0.5)
    assert coverage_table(groups).rows[1][:5] == ("condition", "sun", 2, 2, 0.0)


@pytest.mark.parametrize(
    ("hits", "as_stated"), [(348, True), (347, False), (372, True), (373, False)]
)
def test_large_groups_have_fixed_bounds(
    make_record: MakeRecord, hits: int, as_stated: bool
) -> None:
    # 87 % of 400 are 348, 93 % are 372.
    records = [make_record(f"c{k}", lengths_m={"M6": 0.2}) for k in range(400)]
    high = np.where(np.arange(400) < hits, 0.3, 0.15)
    groups = coverage_by_group(with_interval(records, 0.1, high), LengthDefinition.CENTRELINE)
    assert bool(groups["as_stated"][0]) is as_stated


def test_each_length_has_its_own_interval(make_record: MakeRecord) -> None:
    frame = with_interval([make_record(lengths_m={"M6 thread": 0.22})], 0.21, 0.23)
    assert coverage_by_group(frame, LengthDefinition.CENTRELINE).empty
    assert coverage_by_group(frame, LengthDefinition.THREAD)["hits"].tolist() == [1]


def test_coverage_is_told_apart_by_colour() -> None:
    groups = pd.DataFrame(
        [
            {"factor": "tilt (°)", "group": "0 to 15", "hits": 9, "low": 0.555, "high": 0.997},
            {"factor": "tilt (°)", "group": "15 to 30", "hits": 2, "low": 0.025, "high": 0.556},
        ]
    ).assign(captures=10, fruit=10, width_percent=5.0, as_stated=[True, False])
    both = coverage_plot(groups)
    assert not len(pixels(coverage_plot(groups[:1]), "M6"))
    # The right one is drawn first, further up, and its bar lies further to the right.
    blue, orange = pixels(both, "M5"), pixels(both, "M6")
    assert len(blue)
    assert len(orange)
    assert blue[:, 0].max() < orange[:, 0].min()
    assert blue[:, 1].mean() > orange[:, 1].mean()


def test_an_error_that_grows_with_tilt_climbs(make_record: MakeRecord) -> None:
    # M6 is right; M5 reads a tenth of the truth at tilts beyond 30 degrees.
    records = [
        make_record(
            f"c{k}", tilt_deg=10.0 * k, lengths_m={"M5": 0.02 if k > 3 else 0.1998, "M6": 0.2}
        )
        for k in range(7)
    ]
    scored = against(readings_frame(records), LengthDefinition.CENTRELINE)
    png = error_by_value_plot(
        scored, LengthDefinition.CENTRELINE, scored["tilt_deg"], TILT_EDGES_DEG, "tilt (°)"
    )
    m5 = pixels(png, "M5")
    inside = m5[m5[:, 1] < 0.8 * picture(png).shape[1]]  # the legend stands outside
    third = np.quantile(inside[:, 1], [0.1, 0.9])
    left, right = inside[inside[:, 1] < third[0]], inside[inside[:, 1] > third[1]]
    assert right[:, 0].mean() < left[:, 0].mean()  # higher in the picture
