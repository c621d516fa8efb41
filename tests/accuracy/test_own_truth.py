from __future__ import annotations

import csv
import math
from pathlib import Path

import pytest
from tests.accuracy.conftest import HEAD, write

from cucumbervision.accuracy.own_truth import (
    Measured,
    OwnTruth,
    Reading,
    evaluate_lengths,
    read_measured,
    write_own_truth,
)
from cucumbervision.accuracy.truth import read_truth
from cucumbervision.errors import CucumberVisionError, TruthError
from cucumbervision.methods.result import LengthDefinition


def run_of(*readings: Reading) -> Measured:
    return Measured(Path("run.json"), readings, tuple(dict.fromkeys(r.capture for r in readings)))


def reading(capture: str, fruit: int, **lengths_m: float | None) -> Reading:
    return Reading(capture, fruit, lengths_m)


def test_metrics_by_hand(tmp_path: Path) -> None:
    truth = write(
        tmp_path, HEAD + ",specimen", "a,1,20,thread,s1", "b,1,20,thread,s1", "a,2,10,thread,s2",
        "b,missed,10,thread,s3",
    )  # fmt: skip
    measured = run_of(
        reading("a", 1, M3=0.19, M5=None),
        reading("b", 1, M3=0.22, M5=0.20),
        reading("a", 2, M3=0.10, M5=0.10),
    )
    found = evaluate_lengths(measured, read_truth(truth))
    by_method = {s.method: s for s in found.scores}
    # Errors of M3: 5 %, 10 %, 0 %, and 100 % for the fruit that nobody found.
    assert by_method["M3"].mape_percent == pytest.approx(115 / 4)
    assert by_method["M3"].measured == 0.75
    assert by_method["M5"].mape_percent == pytest.approx(50)
    assert by_method["M3"].fruit == 3
    # Whole fruit are drawn: s1 alone averages 7.5 %, s2 alone 0, s3 alone 100.
    assert by_method["M3"].low_percent >= 0
    assert by_method["M3"].high_percent <= 100
    assert any("1 fruit were not found" in note for note in found.notes)
    assert [one.specimen for one, _ in found.pairs] == ["s1", "s1", "s2", "s3"]


def test_one_fruit_many_times_has_no_interval(tmp_path: Path) -> None:
    lines = [f"{name},1,20,thread,s1" for name in "abcd"]
    measured = run_of(*(reading(name, 1, M3=0.19) for name in "abcd"))
    truth = read_truth(write(tmp_path, HEAD + ",specimen", *lines))
    (score,) = evaluate_lengths(measured, truth).scores
    assert (score.fruit, score.count) == (1, 4)
    assert math.isnan(score.low_percent)


def test_each_kind_has_its_own_methods(tmp_path: Path) -> None:
    truth = write(tmp_path, HEAD, "a,1,20,thread", "a,1,18,chord")
    lengths = {"M3": 0.18, "M6": 0.19, "M6 thread": 0.2, "M6 chord": 0.18, "reported": 0.2}
    measured = run_of(Reading("a", 1, dict(lengths), kind="thread"))
    found = evaluate_lengths(measured, read_truth(truth))
    assert {(s.kind, s.method) for s in found.scores} == {
        (LengthDefinition.THREAD, "M3"),
        (LengthDefinition.THREAD, "M6 thread"),
        (LengthDefinition.THREAD, "reported"),
        (LengthDefinition.CHORD, "M3"),
        (LengthDefinition.CHORD, "M6 chord"),
    }


@pytest.mark.parametrize(
    ("factor", "word"),
    [(10, "millimetres"), (0.01, "metres"), (0.1, "decimetres"), (1 / 2.54, "inches")],
)
def test_another_unit_than_centimetres_is_named(tmp_path: Path, factor: float, word: str) -> None:
    lines = [f"a,{k},{factor * (15 + k):.4f},thread" for k in (1, 2, 3)]
    measured = run_of(*(reading("a", k, M3=(14 + k) / 100) for k in (1, 2, 3)))
    with pytest.raises(TruthError, match=word) as caught:
        evaluate_lengths(measured, read_truth(write(tmp_path, HEAD, *lines)))
    assert "truth.csv" in str(caught.value)


@pytest.mark.parametrize("factor", [0.5, 0.7, 1.45, 2.5])
def test_a_bad_measurement_is_not_taken_for_another_unit(tmp_path: Path, factor: float) -> None:
    truth = write(tmp_path, HEAD, "a,1,20,thread")
    found = evaluate_lengths(run_of(reading("a", 1, M3=0.2 / factor)), read_truth(truth))
    assert found.scores[0].mape_percent == pytest.approx(100 * abs(1 / factor - 1))


@pytest.mark.parametrize(
    ("line", "text"),
    [
        ("c,1,20,thread", r"line 3: capture 'c' is not among the measurements of run.json \(a, b"),
        ("a,9,20,thread", "line 3: capture 'a' has 1 measured fruit, no number 9"),
        ("b,1,210,thread", "line 3: 210 cm is not a plausible length"),
    ],
)
def test_truth_that_fits_no_measurement_is_refused(tmp_path: Path, line: str, text: str) -> None:
    measured = run_of(*(reading(name, 1, M3=0.2) for name in "abd"))
    lines = (HEAD, "a,1,20,thread", line, "d,1,20,thread")
    with pytest.raises(TruthError, match=text):
        evaluate_lengths(measured, read_truth(write(tmp_path, *lines)))


def evaluated(run: Path, table: Path) -> OwnTruth:
    return evaluate_lengths(read_measured(run), read_truth(table))


def test_bundled_captures_against_their_own_truth(run: Path, table: Path) -> None:
    found = evaluated(run, table)
    scores = {(str(s.kind), s.method): s for s in found.scores}
    assert scores["chord", "M3"].count == 8
    assert scores["chord", "M3"].measured == 1
    # Six of eight read the visible chord within 4 %; the depth gate cuts the one tilted by 20°.
    assert scores["chord", "M3"].median_percent < 4
    assert scores["centreline", "M6"].median_percent < 3
    m6 = scores["centreline", "M6"]
    assert scores["centreline", "reported"].mape_percent == m6.mape_percent
    assert ("chord", "reported") not in scores
    assert "Some of these captures are simulated." in found.notes


def test_the_tables_hold_scores_and_each_length(run: Path, table: Path, tmp_path: Path) -> None:
    measured, truth = read_measured(run), read_truth(table)
    found = evaluate_lengths(measured, truth)
    write_own_truth(found, tmp_path)
    assert {p.name for p in tmp_path.iterdir()} == {"scores.csv", "lengths.csv"}
    with (tmp_path / "scores.csv").open(encoding="utf-8-sig", newline="") as file:
        scores = list(csv.DictReader(file))
    assert [(score["kind"], score["method"]) for score in scores] == [
        (str(score.kind), score.method) for score in found.scores
    ]
    assert float(scores[0]["mape_percent"]) == found.scores[0].mape_percent
    with (tmp_path / "lengths.csv").open(encoding="utf-8-sig", newline="") as file:
        lengths = list(csv.DictReader(file))
    assert len(lengths) == len(found.pairs)
    first, reading = found.pairs[0]
    assert float(lengths[0]["true_cm"]) == pytest.approx(100 * first.length_m)
    assert float(lengths[0]["M3_cm"]) == pytest.approx(100 * (reading.lengths_m["M3"] or 0))


@pytest.mark.parametrize(
    ("name", "content", "text"),
    [
        ("measurements.json", "{}", "holds no fruit"),
        ("measurements.json", "{", "is not JSON"),
        ("measurements.json", '{"captures": [{}]}', "has no 'fruit'"),
        ("other.txt", "", "the file is missing; give the folder"),
    ],
)
def test_what_is_no_run_is_refused(tmp_path: Path, name: str, content: str, text: str) -> None:
    (tmp_path / name).write_text(content)
    with pytest.raises(CucumberVisionError, match=text):
        read_measured(tmp_path)
