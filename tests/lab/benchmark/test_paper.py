from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from tests.lab.report.conftest import make_record

from cucumbervision_lab.benchmark.cases import Suite
from cucumbervision_lab.benchmark.paper import (
    paper_section,
    paper_table,
    paper_validation_table,
)
from cucumbervision_lab.report.records import Masks, readings_frame

if TYPE_CHECKING:
    from tests.lab.report.conftest import MakeRecord

__all__ = ["make_record"]  # the fixture


def test_the_papers_own_rows_give_its_own_means() -> None:
    # The paper prints MAE 2.52, 0.95, 1.24, 1.31 and MAPE 9.41, 4.58, 6.45, 7.21.
    table = paper_validation_table()
    assert table.text_rows()[-2][2:] == ["2.52", "0.95", "1.24", "1.31"]
    assert table.text_rows()[-1][2:] == ["9.41", "4.58", "6.45", "7.21"]
    assert not any("M5" in column.head for column in table.columns)


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
    assert here[6:] == pytest.approx((100.0, 50.0))
    assert rows["M2", "the paper"][:6] == (0.83, 1.12, 5.31, "3.97 to 6.60", 0.59, 0.95)
    assert ("M5", "here, disturbed outlines") not in rows
    assert ("M6 thread", "the paper") not in rows
    # Intervals that contradict themselves are not passed on.
    assert rows["M1", "the paper"][3] is None
    assert rows["M5", "the paper"][3] is None


def test_the_section_stands_only_where_the_protocol_was_measured(make_record: MakeRecord) -> None:
    stress = make_record(suite=Suite.STRESS, lengths_m={"M1": 0.2})
    assert paper_section(readings_frame([stress])) is None
    records = [make_record(lengths_m={"M1": 0.2})]
    section = paper_section(readings_frame(records))
    assert section is not None
    assert "M5's mean is not" in section.intro[1]
    assert len(section.entries) == 1
    records.append(make_record("v", suite=Suite.VALIDATION, lengths_m={"M1": 0.2}))
    both = paper_section(readings_frame(records))
    assert both is not None
    assert len(both.entries) == 2
