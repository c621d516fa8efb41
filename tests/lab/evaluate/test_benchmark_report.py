from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from cucumbervision.accuracy.statistics import ReportTable
from cucumbervision.methods.result import LengthDefinition
from cucumbervision_lab.evaluate.benchmark_report import (
    accuracy_table,
    benchmark_tables,
    comparable_readings,
    group_tables,
    paper_table,
    write_tables,
)
from cucumbervision_lab.evaluate.cases import Suite
from cucumbervision_lab.evaluate.measure_case import Masks, Row, readings_frame

CENTRELINE = LengthDefinition.CENTRELINE


def row(case: str, lengths_m: Mapping[str, float | None], **changes: Any) -> Row:
    """A fruit of 20 cm along the axis, 22 by thread, 19.5 straight."""
    about = {"suite": Suite.PAPER, "masks": Masks.EXACT, "fruit": case, "condition": "plain"}
    true = {"centreline_m": 0.20, "thread_m": 0.22, "chord_m": 0.195, "distance_m": 0.5}
    pose = {"tilt_deg": 0.0, "bend_radius_m": None, "hidden_share": 0.0, "fill": 1.0}
    head = {"case": case, "depth_scale": 1.0, "lengths_m": lengths_m}
    return {**head, **about, **true, **pose, **changes}


def cells(table: ReportTable, name: str) -> dict[str, Any]:
    heads = table.heads
    return next(dict(zip(heads, line, strict=True)) for line in table.rows if line[0] == name)


@pytest.mark.parametrize(
    ("truth", "methods"),
    [
        (CENTRELINE, ["M1", "M5", "M6", "skan", "new tool"]),
        (LengthDefinition.THREAD, ["M1", "M5", "M6", "M6 thread", "skan", "new tool"]),
        (LengthDefinition.CHORD, ["M1", "M5", "M6 chord", "skan", "new tool"]),
    ],
)
def test_each_method_is_compared_with_what_it_measures(
    truth: LengthDefinition, methods: list[str]
) -> None:
    names = ["M6 chord", "M6 thread", "M6", "M5", "new tool", "skan", "M1"]
    scored = comparable_readings(readings_frame([row("a", dict.fromkeys(names, 0.2))]), truth)
    assert list(scored["method"].cat.categories) == methods


def test_accuracy_by_hand() -> None:
    # M1 errs +1 cm (5 %), -3 cm (15 %) and refuses once (20 cm, 100 %): MAE 24 / 3, MAPE 40,
    # median 15, worst 100, RMSE sqrt((1 + 9 + 400) / 3), bias (5 - 15) / 2, measured 2 of 3.
    rows = [
        row(f"c{k}", {"M1": x}, fruit="one" if k < 2 else "two")
        for k, x in enumerate([0.21, 0.17, None])
    ]
    found = cells(accuracy_table(readings_frame(rows), CENTRELINE), "M1")
    # By fruit there are but three resamples: one twice (10 %), two twice (100 %), and both. Each
    # of the first two has a quarter of the chance, so the interval reaches from 10 to 100.
    # By capture the mean of three draws of 5, 15, 100; all 5 has 1/27 = 3.7 %, above the tail.
    text = {"95 % by fruit (%)": "10.00 to 100.00", "95 % by capture (%)": "5.00 to 100.00"}
    numbers = {"captures": 3, "fruit": 2, "measured (%)": 200 / 3, "MAE (cm)": 8.0}
    numbers |= {"MAPE (%)": 40.0, "RMSE (cm)": (410 / 3) ** 0.5, "median error (%)": 15.0}
    numbers |= {"worst error (%)": 100.0, "bias (%)": -5.0}
    assert {head: found[head] for head in text} == text
    assert {head: found[head] for head in numbers} == pytest.approx(numbers)


def grouped(rows: list[Row]) -> ReportTable:
    (table,) = group_tables(comparable_readings(readings_frame(rows), CENTRELINE), CENTRELINE)
    return table


def test_bounds_belong_to_the_upper_group_and_the_last_is_closed() -> None:
    tilts = [0, 14.9, -15, 30, 45, 60, 61]
    table = grouped([row(f"c{t}", {"M1": 0.2}, tilt_deg=float(t)) for t in tilts])
    counts = {"0 to 15": 2, "15 to 30": 1, "30 to 45": 1, "45 to 60": 2, "above 60": 1}
    assert {line[0]: line[1] for line in table.rows} == counts


def test_groups_by_hand() -> None:
    # Straight: M6 errs 1 and 3 %, M1 refuses once and is right once. Bent: 10 and 20 %.
    table = grouped(
        [
            row("a", {"M1": None, "M6": 0.202}),
            row("b", {"M1": 0.2, "M6": 0.194}),
            row("c", {"M1": 0.16, "M6": 0.18}, bend_radius_m=0.3),
        ]
    )
    assert table.heads == [
        *("radius of the bend (cm)", "captures", "fruit", "M1 MAPE (%)", "M6 MAPE (%)"),
        *("M6 median (%)", "M6 worst (%)", "M6 measured (%)"),
    ]
    straight, bent = table.rows
    assert straight[:3] == ("straight", 2, 2)
    assert straight[3:] == pytest.approx((50.0, 2.0, 2.0, 3.0, 100.0))
    assert bent[0] == "30 and more"
    assert bent[3:] == pytest.approx((20.0, 10.0, 10.0, 10.0, 100.0))


def test_fruit_that_m6_flags_are_a_group_of_their_own() -> None:
    rows = [row(f"c{k}", {"M6": 0.2}, m6_flags=f) for k, f in enumerate([[], [], ["end-hidden"]])]
    table = grouped([*rows, row("c3", {"M6": None})])
    assert table.heads[0] == "M6's flags"
    assert [line[:2] for line in table.rows] == [("none", 2), ("some, or not measured", 2)]


def test_the_paper_stands_beside_its_protocol_alone() -> None:
    stress = row("a", {"M1": 0.11}, suite=Suite.STRESS)
    assert paper_table(readings_frame([stress])) is None
    disturbed = row("a", {"M1": 0.11, "M6 thread": 0.22}, masks=Masks.DISTURBED)
    table = paper_table(readings_frame([stress, disturbed]))
    assert table is not None
    lines = {line[:2]: line[2:] for line in table.rows}
    # Half of 22 cm: 11 cm, 50 %. One truth only has no R², one capture no interval.
    here = lines["M1", "here, disturbed outlines"]
    assert here[:5] == pytest.approx((11.0, 11.0, 50.0, None, 11.0))
    assert here[6:] == pytest.approx((100.0, 50.0))  # measured, median error
    assert lines["M2", "the paper"][:6] == (0.83, 1.12, 5.31, "3.97 to 6.60", 0.59, 0.95)
    # Intervals that contradict themselves are not passed on.
    assert lines["M1", "the paper"][:4] == (1.63, 2.26, 9.68, None)
    assert not {("M5", "here, disturbed outlines"), ("M6 thread", "the paper")} & set(lines)


def drawn() -> pd.DataFrame:
    rng, rows = np.random.default_rng(0), []
    for k in range(12):
        true = float(rng.uniform(0.08, 0.25))
        near = {m: true * float(rng.normal(1, sd)) for m, sd in (("M1", 0.1), ("M5", 0.05))}
        more = {"centreline_m": true, "thread_m": 1.1 * true, "chord_m": None, "tilt_deg": 5.0 * k}
        rows.append(row(f"p{k}", near, fruit=f"f{k % 4}", **more))
    stress = [{**r, "suite": Suite.STRESS, "masks": Masks.DISTURBED} for r in rows]
    validation = [{**r, "suite": Suite.VALIDATION} for r in rows[:2]]
    return readings_frame([*rows, *stress, *validation])


def test_tables_of_each_suite_and_kind_of_masks() -> None:
    tables = {table.title: table for table in benchmark_tables(drawn())}
    assert next(iter(tables)) == "The paper's figures, on its own captures, beside this program's"
    assert list(dict.fromkeys(title.split(": ")[0] for title in tables if ": " in title)) == [
        "The paper's protocol, exact outlines",
        "The five validation fruit, exact outlines",
        "The stress set, outlines disturbed by 1.5 px",
    ]
    accuracy = tables["The paper's protocol, exact outlines: Accuracy against the centreline"]
    assert (cells(accuracy, "M5")["captures"], cells(accuracy, "M5")["fruit"]) == (12, 4)
    grouped_by = [title.split(": ")[1] for title in tables if ": By" in title]
    # Two captures of the validation fruit are too few for groups.
    assert "By tilt (°), against the centreline" in grouped_by
    assert not any(title.startswith("The five") and ": By" in title for title in tables)


def test_tables_are_written_with_unrounded_numbers(tmp_path: Path) -> None:
    table = ReportTable.of("Bursts", ["frames", "MAPE (%):.1"], [[5, 0.123], [1, float("nan")]])
    path = write_tables(tmp_path / "new" / "benchmark.json", {"stress fruit": 3}, [table])
    rows = [{"frames": 5, "MAPE (%)": 0.123}, {"frames": 1, "MAPE (%)": None}]
    expected = {"stress fruit": 3, "tables": [{"title": "Bursts", "comment": "", "rows": rows}]}
    assert json.loads(path.read_text("utf-8")) == expected
