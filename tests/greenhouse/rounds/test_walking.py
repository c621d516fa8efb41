from __future__ import annotations

import pytest

from cucumbervision.capture.frames import Stop
from cucumbervision_greenhouse.rounds.walking import unless_taken


@pytest.mark.parametrize(
    ("walked_m", "pressed_m", "kept_m"),
    [
        ([0.0, 0.4], 0.4, 0.8),
        ([0.0, 0.4, 0.8], 0.4, 1.2),
        ([2.0, 1.5], 1.5, 1.0),  # backwards
        ([0.5, 0.0], 0.0, 1.0),  # the row ends: on from its other end
        ([0.4, 0.8, 0.0], 0.8, 1.6),  # the last two lie 0.8 apart
        ([0.0], 0.004, 0.4),  # less than what is typed apart
        ([0.0], 0.01, 0.01),
    ],
)
def test_a_place_that_is_taken_goes_on_from_the_last(
    walked_m: list[float], pressed_m: float, kept_m: float
) -> None:
    walked = [Stop("3", "left", at_m) for at_m in walked_m]
    kept = unless_taken(Stop("3", "left", pressed_m, 9), walked)
    assert kept.position_m == pytest.approx(kept_m)
    assert (kept.row, kept.side, kept.step) == ("3", "left", 9)
