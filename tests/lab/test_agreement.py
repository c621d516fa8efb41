from __future__ import annotations

import math
from pathlib import Path

import pytest

from cucumbervision.accuracy.own_truth import Measured, OwnTruth, Reading
from cucumbervision.accuracy.truth import TrueLength
from cucumbervision.methods.result import LengthDefinition
from cucumbervision_lab.agreement import agreement, agreement_rows, hidden_table, plot_agreement


def test_statistics_by_hand() -> None:
    # Differences of +1, -1, +1 cm: mean 1/3, variance (4/9 + 16/9 + 4/9) / 2 = 4/3.
    found = agreement([0.11, 0.19, 0.31], [0.10, 0.20, 0.30], ["a", "b", "c"])
    sd = math.sqrt(4 / 3)
    assert (found["low_cm"], found["high_cm"]) == pytest.approx(
        (1 / 3 - 1.95996 * sd, 1 / 3 + 1.95996 * sd), abs=1e-4
    )
    assert found["limit_margin_cm"] == pytest.approx(4.30265 * sd, rel=1e-5)  # t of 2 degrees
    assert found["rmse_cm"] == pytest.approx(1.0)
    # Covariance 200 / 3, variances 202.667 / 3 and 200 / 3, squared bias 1 / 9.
    assert found["ccc"] == pytest.approx(400 / (202 + 2 / 3 + 200 + 1 / 3))
    # Mean squares: fruit 200.667, rater 1/6, rest (1.5 - 1/6) / 2.
    assert found["icc"] == pytest.approx(200 / 201)
    assert found["fruit_needed"] == math.ceil((1.95996 * sd / 0.1) ** 2)
    assert math.isnan(found["repeat_sd_cm"])


def test_repeatability_is_the_spread_within_specimens() -> None:
    # Within a: 0.2² + 0.2²; within b: 0.2² + 0 + 0.2²; three degrees of freedom.
    lengths, specimens = [0.200, 0.204, 0.100, 0.102, 0.104], ["a", "a", "b", "b", "b"]
    found = agreement(lengths, [0.2, 0.2, 0.1, 0.1, 0.1], specimens)
    assert found["repeat_sd_cm"] == pytest.approx(math.sqrt(0.16 / 3))
    assert found["repeat_limit_cm"] == pytest.approx(1.95996 * math.sqrt(2 * 0.16 / 3), rel=1e-5)
    assert (found["pairs"], found["fruit"]) == (5, 2)


@pytest.fixture
def measured() -> tuple[Measured, OwnTruth]:
    """Four fruit of 20 cm read 21, 19, 20 and not at all; the second is half hidden."""
    kind, pairs, rows = LengthDefinition.CENTRELINE, [], []
    for number, (length_m, hidden) in enumerate([(0.21, 0), (0.19, 0.55), (0.2, 1), (None, None)]):
        place = {"line": number, "capture": "a", "fruit": number, "specimen": f"s{number}"}
        truth = TrueLength(kind=kind, lengths_m=(0.2,), **place)  # type: ignore[arg-type]
        pairs.append((truth, Reading("a", number, {"reported": length_m}, kind=str(kind))))
        interval = {"interval_low_cm": 19.5, "interval_high_cm": 21.5, "interval_of": str(kind)}
        rows.append({"fruit": number, "hidden_share": hidden, **(interval if number else {})})
    rows[1] |= {"interval_high_cm": 19.8}
    report = {"captures": [{"name": "a", "fruit": rows}]}
    readings = tuple(reading for _, reading in pairs)
    return Measured(Path("run.json"), readings, ("a",), report), OwnTruth(
        tuple(pairs), (), None, ()
    )


def test_error_and_coverage_by_tenths_of_what_is_hidden(
    measured: tuple[Measured, OwnTruth],
) -> None:
    rows = hidden_table(*measured).text_rows()
    assert [row[1:] for row in rows] == [
        ["0 to 10", "1", "5.0", "+5.0", "0", "–"],
        ["50 to 60", "1", "5.0", "−5.0", "1", "0"],
        ["90 to 100", "1", "0.0", "+0.0", "1", "100"],
    ]


def test_measured_fruit_alone_are_compared_and_drawn(
    measured: tuple[Measured, OwnTruth], tmp_path: Path
) -> None:
    (row,) = agreement_rows(measured[1])
    assert (row["method"], row["pairs"], row["rmse_cm"]) == (
        "reported",
        3,
        pytest.approx((2 / 3) ** 0.5),
    )
    pytest.importorskip("matplotlib")
    (file,) = plot_agreement(measured[1], tmp_path)
    assert file.read_bytes().startswith(b"\x89PNG")
