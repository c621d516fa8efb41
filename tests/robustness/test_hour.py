"""What the hour's stream calls a leak."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from tests.robustness.hour import Look, faults_of


@pytest.mark.parametrize(
    ("memory_mb", "is_leak"),
    [
        (lambda minute: 164 + min(minute, 20) / 2, False),  # a warm-up
        (lambda minute: 164 + minute / 4, True),
        (lambda minute: 164 if minute < 20 else 210, True),
    ],
)
def test_a_leak_goes_on_and_a_warm_up_ends(
    memory_mb: Callable[[int], float], is_leak: bool
) -> None:
    looks = [Look(memory_mb(minute), files=9, threads=3, busy_s=1.0) for minute in range(60)]
    assert bool(faults_of(looks)) is is_leak
