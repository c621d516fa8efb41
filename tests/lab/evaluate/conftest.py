from __future__ import annotations

from dataclasses import replace
from typing import Any, Protocol

import pytest

from cucumbervision_lab.evaluate.measure_case import LengthRecord, Masks


class MakeRecord(Protocol):
    def __call__(self, case: str = ..., /, **changes: Any) -> LengthRecord: ...


@pytest.fixture
def make_record() -> MakeRecord:
    """Give a maker of records: 20 cm along the axis, 22 by thread, 19.5 straight."""

    def make(case: str = "a", /, **changes: Any) -> LengthRecord:
        record = LengthRecord(
            case=case,
            suite="paper",
            masks=Masks.EXACT,
            fruit=case,
            centreline_m=0.20,
            thread_m=0.22,
            chord_m=0.195,
            distance_m=0.5,
            tilt_deg=0.0,
            bend_radius_m=None,
            hidden_share=0.0,
            fill=1.0,
        )
        return replace(record, **changes)

    return make
