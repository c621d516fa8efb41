from __future__ import annotations

import pytest

from cucumbervision_lab.training.settings import one_to_many_at, rate_at


def test_what_falls_over_the_plan() -> None:
    assert [rate_at(t) for t in (0.0, 1.0)] == pytest.approx([1.0, 0.05])
    assert [one_to_many_at(t, 0.3) for t in (0.0, 0.5, 1.0)] == pytest.approx([0.3, 0.2, 0.1])
    # A network that already gives it less keeps that.
    assert one_to_many_at(1.0, 0.05) == pytest.approx(0.05)
