"""A length's interval, against quantiles worked out by hand."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from cucumbervision.methods.result import Length


@pytest.mark.parametrize(
    ("value_m", "ends_m"),
    [(0.171, (0.171, 0.248)), (0.21, (0.198, 0.248)), (0.26, (0.198, 0.26)), (0.198, None)],
)
def test_a_length_lies_inside_its_interval(
    value_m: float, ends_m: tuple[float, float] | None
) -> None:
    """What a model of intervals expects of a fruit may lie beyond what was seen of it."""
    length = Length(value_m, low_m=0.198, high_m=0.248)
    assert (length.low_m, length.high_m) == (ends_m or (0.198, 0.248))
    moved = replace(length, value_m=0.3)
    assert moved.high_m == 0.3


@pytest.mark.parametrize("ends", [(None, 0.3), (0.26, 0.24), (-0.1, 0.2), (0.1, math.nan)])
def test_what_is_no_interval_gives_no_deviation(ends: tuple[float | None, float]) -> None:
    assert Length(0.25, low_m=ends[0], high_m=ends[1]).relative_sd is None
