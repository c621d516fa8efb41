from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from tests.lab.evaluate.conftest import make_record

from cucumbervision_lab.evaluate.benchmark_report import paper_table
from cucumbervision_lab.evaluate.cases import Suite
from cucumbervision_lab.evaluate.measure_case import Masks, readings_frame

if TYPE_CHECKING:
    from tests.lab.evaluate.conftest import MakeRecord

__all__ = ["make_record"]  # the fixture


def test_the_paper_stands_beside_its_protocol_alone(make_record: MakeRecord) -> None:
    stress = make_record(suite=Suite.STRESS, lengths_m={"M1": 0.11})
    assert paper_table(readings_frame([stress])) is None
    disturbed = make_record(masks=Masks.DISTURBED, lengths_m={"M1": 0.11, "M6 thread": 0.22})
    table = paper_table(readings_frame([stress, disturbed]))
    assert table is not None
    rows = {(row[0], row[1]): row[2:] for row in table.rows}
    # Half of 22 cm: 11 cm, 50 %. One truth only has no R².
    here = rows["M1", "here, disturbed outlines"]
    assert here[:3] == pytest.approx((11.0, 11.0, 50.0))
    assert here[3] is None  # one capture has no interval
    assert here[4] == pytest.approx(11.0)
    assert rows["M1", "the paper"][:3] == (1.63, 2.26, 9.68)
    assert here[6:] == pytest.approx((100.0, 50.0))  # measured, median error
    assert rows["M2", "the paper"][:6] == (0.83, 1.12, 5.31, "3.97 to 6.60", 0.59, 0.95)
    assert ("M5", "here, disturbed outlines") not in rows
    assert ("M6 thread", "the paper") not in rows
    # Intervals that contradict themselves are not passed on.
    assert rows["M1", "the paper"][3] is None
    assert rows["M5", "the paper"][3] is None
