from __future__ import annotations

from pathlib import Path

import pytest
from tests.accuracy.test_own_truth import evaluated

from cucumbervision.accuracy.own_truth import read_measured
from cucumbervision.errors import CucumberVisionError


def test_csv_and_json_of_one_run_say_the_same(run: Path, table: Path, tmp_path: Path) -> None:
    alone = tmp_path / "measurements.csv"
    alone.write_bytes((run / "measurements.csv").read_bytes())
    by_csv, by_json = evaluated(alone, table), evaluated(run / "measurements.json", table)
    assert [s.method for s in by_csv.scores] == [
        s.method for s in by_json.scores if s.metrics.measured > 0
    ]
    assert [reading.lengths_m["M3"] for _, reading in by_csv.pairs] == [
        reading.lengths_m["M3"] for _, reading in by_json.pairs
    ]
    european = tmp_path / "excel.csv"
    text = alone.read_text(encoding="utf-8-sig").replace(",", ";").replace(".", ",")
    european.write_text(text, encoding="utf-8-sig")
    assert [s.metrics.mae_cm for s in evaluated(european, table).scores] == [
        s.metrics.mae_cm for s in by_csv.scores
    ]


@pytest.mark.parametrize(
    ("name", "content", "text"),
    [
        ("measurements.json", "{}", "holds no measurements"),
        ("measurements.json", "{", "is not JSON"),
        (
            "measurements.json",
            '{"captures": [{"name": "a", "intrinsics": {}, "fruit": '
            '[{"capture": "a", "fruit": 1, "mask_source": ["sam"]}]}]}',
            "mask_source is not text",
        ),
        ("measurements.csv", "a,b\n1,2\n", "holds no measurements"),
        ("measurements.csv", "capture,fruit,length_cm\n", "holds no fruit"),
        ("measurements.csv", "capture,fruit,length_cm\na,x,3\n", "is damaged or of another form"),
        ("other.txt", "", "holds no measurements"),
    ],
)
def test_what_is_no_run_is_refused(tmp_path: Path, name: str, content: str, text: str) -> None:
    (tmp_path / name).write_text(content)
    with pytest.raises(CucumberVisionError, match=text):
        read_measured(tmp_path)
